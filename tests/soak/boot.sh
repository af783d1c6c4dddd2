#!/usr/bin/env bash
# Boots the Debian in a folder with its systemd as process 1, in namespaces of its own (processes, mounts, host name, IPC,
# network, control groups): boot.sh ROOT GROUP. Needs root. It ends with this process. GROUP is the name of its control
# group.
set -euo pipefail
root=$1 group=$2
for hierarchy in /sys/fs/cgroup /sys/fs/cgroup/unified /sys/fs/cgroup/systemd; do
	[ -w "$hierarchy/cgroup.procs" ] && mkdir -p "$hierarchy/$group" && echo $$ >"$hierarchy/$group/cgroup.procs"
done
exec unshare --pid --fork --kill-child --mount --uts --ipc --net --cgroup bash -euc '
mount --make-rprivate /
mount --bind "$1" "$1"
cd "$1"
mount -t proc proc proc
mount -t sysfs sysfs sys
mount -t cgroup2 cgroup2 sys/fs/cgroup
mount -t tmpfs -o mode=755 tmpfs run
mount -t tmpfs tmpfs tmp
mount -t tmpfs -o mode=755 tmpfs dev
while read -r name major minor; do mknod -m 666 "dev/$name" c "$major" "$minor"; done <<<"null 1 3
zero 1 5
full 1 7
random 1 8
urandom 1 9
tty 5 0"
mkdir -p dev/pts dev/shm old
mount -t devpts -o newinstance,ptmxmode=0666,mode=620 devpts dev/pts
mount -t tmpfs tmpfs dev/shm
ln -s pts/ptmx dev/ptmx
ln -s /proc/self/fd dev/fd
hostname debian
pivot_root . old
umount -l /old
exec env -i container=other PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system --log-target=journal --show-status=0 --unit=multi-user.target
' boot "$root" </dev/null
