#!/usr/bin/env bash
# RabbitCT's backprojection on the CPU and, where there is one, on a card: rabbitct.sh SIZE ... (voxels a side). RABBITCT
# names the data set, RABBITCT_LOLA the public runner (github.com/HPC-Dwarfs/RabbitCT), THREADS how many both take.
set -euo pipefail
cd "$(dirname "$0")/../.."
build=${BUILD:-build}
data=${RABBITCT:-$build/bench/rabbitct-60.rct}
threads=${THREADS:-$(nproc)}
export OMP_WAIT_POLICY=passive
mkdir -p "$build/bench"
[[ -e $data ]] || "$build/rabbitct" make "$data" 60

for size in "$@"; do
	"$build/rabbitct" run "$data" "$size" cpu "$threads"
	if [[ -n ${RABBITCT_LOLA:-} ]]; then
		# It wants the matrices alone in a second file, and keeps which voxels are seen in a folder of its own.
		work=$(mktemp -d)
		mkdir "$work/RabbitInput"
		python3 - "$data" "$work/geometry.rct" <<-'EOF'
			import struct, sys
			with open(sys.argv[1], "rb") as data, open(sys.argv[2], "wb") as matrices:
			    header = data.read(20)
			    columns, rows, views = struct.unpack("<III", header[:12])
			    matrices.write(header)
			    for view in range(views):
			        data.seek(20 + view * (96 + 4 * columns * rows))
			        matrices.write(data.read(96))
		EOF
		input=$(realpath "$data") runner=$(realpath "$RABBITCT_LOLA")
		(cd "$work" && OMP_NUM_THREADS=$threads "$runner" -i "$input" -a geometry.rct -m LolaASM -s "$size" -v) |
			sed -n 's/^Total: */LolaASM: /p'
		rm -rf "$work"
	fi
	if nvidia-smi -L >/dev/null 2>&1; then
		"$build/rabbitct" run "$data" "$size" cuda
	fi
done
