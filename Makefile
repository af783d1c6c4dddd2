# cbctd: cone-beam reconstruction as a service. `make help` lists the targets.
# Everything is built out of tree under build/.

.DEFAULT_GOAL := all
BUILD ?= build
ifeq ($(origin CC),default)
CC := gcc
endif
# V=1 shows the commands.
V ?= 0
comma := ,
NVCC ?= nvcc
# Debian's own, which sees Debian's modules.
PYTHON ?= /usr/bin/python3
# POSTGRESQL=0 leaves the catalogue in PostgreSQL out.
# CUDA=0 leaves the CUDA backend out; otherwise it is built where nvcc is found and its libraries can be linked.
# nvcc itself says where they are: the one on the PATH may be a link or a script.
ifneq ($(CUDA),0)
cuda_paths := $(shell $(NVCC) --dryrun -x cu -c /dev/null 2>&1 | sed -n 's/^\#\$$ LIBRARIES= *//p' | tr -d '"')
cuda_libs  := $(cuda_paths) $(patsubst -L%,-Wl$(comma)-rpath$(comma)%,$(filter-out %/stubs,$(cuda_paths))) -lcufft -lcudart -lstdc++
CUDA := $(shell command -v $(NVCC) >/dev/null && echo 'int main(void) { return 0; }' | \
          $(CC) -x c - $(cuda_libs) -o /dev/null 2>/dev/null && echo 1 || echo 0)
ifeq ($(CUDA)$(MAKELEVEL),00)
$(info building without the CUDA backend: no nvcc with its libraries here)
endif
endif
# Machine code for these cards, and PTX for later ones. CUDA_ARCH=90 for a quick build.
CUDA_ARCH ?= 75 80 86 89 90 100 120
CUDA_PTX ?= $(lastword $(CUDA_ARCH))
SANITIZE ?=
SANITIZED ?= 0
# 1 in CI and for developers; a newer compiler's new warning breaks nobody else's build.
WERROR ?= 0
prefix ?= /usr/local

# pkg-config name:Debian package, then command:Debian package.
PACKAGES := libmicrohttpd:libmicrohttpd-dev gnutls:libgnutls28-dev libcjson:libcjson-dev libzstd:libzstd-dev sqlite3:libsqlite3-dev \
            kissfft-float:libkissfft-dev libpng:libpng-dev libcurl:libcurl4-openssl-dev libcrypto:libssl-dev \
            expat:libexpat1-dev libtiff-4:libtiff-dev zlib:zlib1g-dev check:check
COMMANDS := gcc:gcc pkg-config:pkg-config curl:curl jq:jq zstd:zstd openssl:openssl pgrep:procps sqlite3:sqlite3 \
            mypy:mypy dcmdump:dcmtk
# What is done without where it cannot be had: the web page, and its tests in a browser.
OPTIONAL := node:nodejs npm:npm
# Of Python: yaml for the build, the others for tests.
MODULES  := yaml:python3-yaml jsonschema:python3-jsonschema numpy:python3-numpy requests:python3-requests

core_libs   := kissfft-float
proto_libs  := libcjson libzstd libpng zlib libcrypto
daemon_libs := libmicrohttpd gnutls sqlite3
# The catalogue in PostgreSQL is left out where libpq's header is not installed, and the setting refused by name. The
# library is loaded when it is asked for.
postgresql  := $(if $(filter 0,$(POSTGRESQL)),,$(shell pkg-config --exists libpq 2>/dev/null && echo libpq))
# Other tools' files: the client reads and writes them, the daemon and the worker know none of them.
files_libs  := expat libtiff-4
cbct_libs   := libcurl $(files_libs)
# cbct-dicom, which sends volumes to archives.
dicom_libs  := libcurl
# Its C-STORE, worklist and listener, by DCMTK, are built where libdcmtk-dev is found (its .pc asks for more than there is).
CXX_DCMTK   := $(shell $(CXX) -x c++ -E -include dcmtk/config/osconfig.h /dev/null >/dev/null 2>&1 && echo 1)
ifeq ($(CXX_DCMTK),1)
dcmtk_objects = $(patsubst %.cc,$(BUILD)/%.o,$(wildcard daemon/dicom/*.cc))
dcmtk_libs    = -ldcmtls -ldcmnet -ldcmdata -loflog -lofstd $(call pkg,--libs,libssl libcrypto) -lstdc++
endif
all_libs    := $(core_libs) $(proto_libs) $(daemon_libs) $(cbct_libs)

pkg = $(shell pkg-config $(1) $(2) 2>/dev/null)

WARN   := -Wall -Wextra -Wpedantic $(if $(filter 1,$(WERROR)),-Werror)
CFLAGS ?= -O2 -g
OPENMP ?= -fopenmp
pkg_cflags := $(call pkg,--cflags,$(all_libs) $(postgresql))
# Errors of the maths library are not read from errno, traps are off: the compiler may vectorise.
override CFLAGS += -std=c11 -D_GNU_SOURCE -I. $(WARN) $(or $(OPENMP),-Wno-unknown-pragmas) -fno-math-errno \
                   -fno-trapping-math -MMD -MP $(pkg_cflags) -ffile-prefix-map=$(CURDIR)=. \
                   $(if $(SANITIZE),-fsanitize=$(SANITIZE) -fno-omit-frame-pointer)
cxx_flags     = -O2 -g -std=c++17 -I. $(WARN) -MMD -MP -ffile-prefix-map=$(CURDIR)=. \
                $(if $(SANITIZE),-fsanitize=$(SANITIZE) -fno-omit-frame-pointer)
bundle_flags := -Wl,--disable-new-dtags,-rpath,'$$ORIGIN/../lib'
override LDFLAGS += $(if $(BUNDLE),$(bundle_flags)) $(OPENMP) $(if $(SANITIZE),-fsanitize=$(SANITIZE))
LIBM := -lm -lpthread

# core/cpu/*_simd.c are compiled once for each instruction set; core/cpu/cpu.c picks one at run time.
SIMD_ISAS    := base avx2 avx512
flags_base   :=
flags_avx2   := -mavx2 -mfma -mf16c
flags_avx512 := -mavx512f -mavx512bw -mavx512dq -mavx512vl -mfma -mprefer-vector-width=512

simd_sources   := $(wildcard core/cpu/*_simd.c)
core_sources   := $(filter-out $(simd_sources),$(wildcard core/*.c core/*/*.c))
proto_sources  := $(wildcard proto/*.c)
dicom_sources  := $(wildcard daemon/dicom/*.c)
without        := $(if $(postgresql),,$(wildcard daemon/store/postgresql*.c))
daemon_sources := $(filter-out daemon/worker.c $(dicom_sources) $(without),$(wildcard daemon/*.c daemon/*/*.c))
# What the unit tests know of the daemon: its state, without HTTP.
state_sources  := $(filter-out $(without),$(wildcard daemon/store/*.c daemon/jobs/*.c)) $(patsubst %,daemon/%.c,api/document files histogram id lock log problem process watch watchdog)
cbct_sources   := $(wildcard clients/cbct/*.c)
unit_sources   := $(wildcard tests/unit/*.c) tests/bench/departed.c tests/bench/fdk_volume.c tests/bench/bodies.c

# say NAME: a short line for a recipe, its commands with V=1
say = $(if $(filter 1,$(V)),,@echo '  $(1)' '$(patsubst $(BUILD)/%,%,$@)';)

objects      = $(patsubst %.c,$(BUILD)/%.o,$(1))
simd_objects := $(foreach isa,$(SIMD_ISAS),$(patsubst %.c,$(BUILD)/%.$(isa).o,$(simd_sources)))
core_objects := $(call objects,$(core_sources)) $(simd_objects)
library      := $(BUILD)/libcbct.a

ifeq ($(CUDA),1)
cuda_objects := $(patsubst %.cu,$(BUILD)/%.o,$(wildcard kernels/*.cu))
cuda_seed     = $(if $(cuda_seeded),-frandom-seed=$<)
cuda_seeded  := $(shell $(NVCC) --help | grep -o -m1 frandom-seed)
cuda_code    := $(foreach a,$(CUDA_ARCH),-gencode arch=compute_$(a),code=sm_$(a)) \
                $(foreach a,$(CUDA_PTX),-gencode arch=compute_$(a),code=compute_$(a))
endif

programs := $(BUILD)/cbctd $(BUILD)/cbct-worker $(BUILD)/cbct-dicom $(BUILD)/cbct $(if $(cuda_objects),$(BUILD)/cbct-cuda)

all: $(programs) ## the programs, in build/

$(BUILD)/%.o: %.c
	@mkdir -p $(@D)
	$(call say,CC  )$(CC) $(CFLAGS) -c -o $@ $<

$(BUILD)/%.o: %.cc
	@mkdir -p $(@D)
	$(call say,CXX )$(CXX) $(cxx_flags) -c -o $@ $<

define simd_rule
$(BUILD)/%.$(1).o: %.c
	@mkdir -p $$(@D)
	$$(call say,CC  )$$(CC) $$(CFLAGS) -O3 $$(flags_$(1)) -DSIMD_ISA=$(1) -DSIMD_$(1)=1 -c -o $$@ $$<
endef
$(foreach isa,$(SIMD_ISAS),$(eval $(call simd_rule,$(isa))))

# nvcc names what it makes by its process and by chance, unless it is told otherwise (since 12.5).
$(BUILD)/kernels/%.o: kernels/%.cu
	@mkdir -p $(@D)
	$(call say,NVCC)$(NVCC) -std=c++17 -O3 -lineinfo -I. $(cuda_code) -Xcompiler -Wall,-Wextra $(addprefix -Xcompiler ,$(OPENMP)) $(cuda_seed) -MMD -MP -c -o $@ $< && objcopy --wildcard --strip-symbol='tmpxft_*' $@

# The daemon and the client use the library's backends by table; only the worker,
# the client's `recon` and the GPU tests know of CUDA's row (core/backend.c).
$(library): $(core_objects) $(call objects,$(proto_sources)) $(BUILD)/proto/commit.o
	@rm -f $@
	$(call say,AR  )$(AR) qcs $@ $^

$(BUILD)/proto/openapi.c: proto/openapi.py proto/openapi.yaml
	@mkdir -p $(@D)
	$(call say,YAML)$(PYTHON) $^ >$@.part && mv $@.part $@

$(BUILD)/proto/openapi.o: $(BUILD)/proto/openapi.c
	$(call say,CC  )$(CC) $(CFLAGS) -c -o $@ $<

# The commit of the sources, which volumes carry; "" where nobody knows it. The file changes only when the commit does.
COMMIT ?= $(shell git describe --always --dirty --abbrev=12 --exclude '*' 2>/dev/null)
$(BUILD)/proto/commit.c: again
	@mkdir -p $(@D)
	@printf '#include "proto/version.h"\nconst char program_commit[] = "%s";\n' "$(COMMIT)" >$@.part; \
	cmp -s $@.part $@ && rm $@.part || mv $@.part $@

$(BUILD)/proto/commit.o: $(BUILD)/proto/commit.c
	$(call say,CC  )$(CC) $(CFLAGS) -c -o $@ $<

# The page for the clinician is part of the daemon; without npm there is a plain one.
$(BUILD)/web/assets.c: $(shell find clients/web -name node_modules -prune -o -type f -print) $(if $(wildcard $(BUILD)/web/without),again)
	$(call say,WEB )clients/web/build.sh $(@D)

$(BUILD)/web/assets.o: $(BUILD)/web/assets.c
	$(call say,CC  )$(CC) $(CFLAGS) -c -o $@ $<

$(BUILD)/cbctd: $(call objects,$(daemon_sources)) $(BUILD)/proto/openapi.o $(BUILD)/web/assets.o $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(daemon_libs) $(proto_libs) $(core_libs)) $(LIBM)

$(BUILD)/cbct-worker: $(call objects,daemon/worker.c) $(library) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

$(BUILD)/cbct-dicom: $(call objects,$(dicom_sources)) $(dcmtk_objects) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(dicom_libs) $(proto_libs) $(core_libs)) $(dcmtk_libs) $(LIBM)

$(BUILD)/cbct: $(call objects,$(cbct_sources)) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(cbct_libs) $(proto_libs) $(core_libs)) $(LIBM)

# A worker whose syncs can be held up, and a daemon whose digests, for the tests of what becomes of a volume meanwhile;
# and whose catalogue can be made to refuse.
$(BUILD)/cbct-worker-held: $(call objects,daemon/worker.c tests/http/held.c) $(library) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -Wl,--wrap=fdatasync,--wrap=recon_push,--wrap=backend_find -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

held_calls := live_get oblique_make jobs_promote store_job_volumes job_digest_volume store_job_update store_job_add_volume store_job_digest_volume
# The order of locks is asserted in that daemon, and in the unit tests (tests/lock_order.c).
lock_calls := lock_init pthread_mutex_lock pthread_mutex_unlock pthread_mutex_destroy pthread_cond_wait pthread_cond_timedwait
$(BUILD)/cbctd-held: $(call objects,$(daemon_sources) tests/http/held.c tests/lock_order.c) $(BUILD)/proto/openapi.o $(BUILD)/web/assets.o $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) $(patsubst %,-Wl$(comma)--wrap=%,$(held_calls) $(lock_calls)) -o $@ $^ $(call pkg,--libs,$(daemon_libs) $(proto_libs) $(core_libs)) $(LIBM)

# As where libpq is not installed.
$(BUILD)/cbctd-without-postgresql: $(filter-out $(BUILD)/daemon/store/postgresql%,$(call objects,$(daemon_sources))) $(BUILD)/proto/openapi.o $(BUILD)/web/assets.o $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(daemon_libs) $(proto_libs) $(core_libs)) $(LIBM)

gpu_programs := $(BUILD)/gpu_check $(BUILD)/gpu_bench $(BUILD)/gpu_cards $(BUILD)/gpu_large
# Every program that a test or a benchmark runs, so that none stops compiling unseen.
test-programs: $(addprefix $(BUILD)/,unit member cbct-worker-held cbctd-held cbctd-without-postgresql manual faults.so clock.so every.so live_bytes.so simulated-nvml/libnvidia-ml.so.1 cpu-bench calibrate-bench phantoms agreement breathing scatter refine denoise presets stopping methods watchers slices acquire paper-project rabbitct $(if $(postgresql),claims)) \
               $(if $(cuda_objects),$(gpu_programs) $(BUILD)/gpu_ceilings $(BUILD)/cbct-worker-faulty,$(call objects,$(wildcard tests/bench/gpu_*.c)))

# What tests ask of JSON documents by the thousand.
$(BUILD)/member: tests/http/member.c
	$(call say,CC  )$(CC) -std=c11 -D_GNU_SOURCE -O1 $(WARN) $(call pkg,--cflags,libcjson) -o $@ $< $(call pkg,--libs,libcjson)

# Faults of the disk, loaded into the programs by tests.
$(BUILD)/faults.so: tests/http/faults.c
	$(call say,CC  )$(CC) -std=c11 -O1 -Wall -Wextra -fPIC -shared -o $@ $< -ldl

# One call that fails, a count of what is allocated, or a clock that is off, loaded into the programs by tests.
$(BUILD)/every.so $(BUILD)/live_bytes.so $(BUILD)/clock.so: $(BUILD)/%.so: tests/http/%.c
	$(call say,CC  )$(CC) -std=c11 -O1 -Wall -Wextra -fPIC -shared -o $@ $< -ldl

# Cards that are not there, for tests of what is told of cards.
$(BUILD)/simulated-nvml/libnvidia-ml.so.1: tests/http/simulated_nvml.c
	@mkdir -p $(@D)
	$(call say,CC  )$(CC) -std=c11 -O1 -Wall -Wextra -fPIC -shared -o $@ $<

# What `cbct recon` becomes where a card is wanted.
$(BUILD)/cbct-cuda: $(call objects,$(cbct_sources)) $(library) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(cbct_libs) $(proto_libs) $(core_libs)) $(cuda_libs) $(LIBM)

$(BUILD)/unit: $(call objects,$(unit_sources) $(state_sources) tests/lock_order.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) $(lock_calls:%=-Wl$(comma)--wrap=%) -o $@ $^ $(call pkg,--libs,check sqlite3 $(files_libs) $(proto_libs) $(core_libs)) $(LIBM)

$(BUILD)/cpu-bench: $(call objects,tests/bench/bench.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(LIBM)

# Noise reduction on anatomies: on a card where there is one.
$(BUILD)/denoise: $(call objects,tests/bench/denoise.c tests/unit/anatomy.c) $(core_objects) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

# Backprojection alone, by the rules and the files of RabbitCT.
$(BUILD)/rabbitct: $(call objects,tests/bench/rabbitct.c tests/bench/gpu_scene.c) $(core_objects) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

# What each preset of a job is worth on anatomies.
$(BUILD)/presets: $(call objects,tests/bench/presets.c tests/unit/anatomy.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(LIBM)

# How far from the best iteration automatic stops are.
$(BUILD)/stopping: $(call objects,tests/bench/stopping.c tests/unit/anatomy.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(LIBM)

# Every method beside the others.
$(BUILD)/methods: $(call objects,tests/bench/methods.c tests/unit/anatomy.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(LIBM)

# What the check of the geometry says of scans whose geometry is known.
$(BUILD)/agreement: $(call objects,tests/bench/agreement.c tests/bench/bodies.c tests/unit/arm.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(LIBM)

# Who is told to have breathed.
$(BUILD)/breathing: $(call objects,tests/bench/breathing.c tests/bench/bodies.c tests/unit/arm.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(LIBM)

$(BUILD)/scatter: $(call objects,tests/bench/scatter.c tests/bench/fdk_volume.c tests/unit/exposures.c tests/unit/montecarlo.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(LIBM)

# What the refinement makes of such scans.
$(BUILD)/refine: $(call objects,tests/bench/refine.c tests/bench/departed.c tests/bench/fdk_volume.c tests/bench/bodies.c tests/unit/arm.c) $(core_objects) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

$(BUILD)/calibrate-bench: $(call objects,tests/bench/calibrate.c tests/bench/fdk_volume.c tests/unit/arm.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(LIBM)

# What is said of right phantoms, and of drawings that are wrong.
$(BUILD)/phantoms: $(call objects,tests/bench/phantoms.c tests/unit/arm.c) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(files_libs) $(proto_libs) $(core_libs)) $(LIBM)

# Claims of many workers at once in the ledger of a fleet.
$(BUILD)/claims: $(call objects,tests/bench/claims.c $(state_sources)) $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,sqlite3 $(files_libs) $(proto_libs) $(core_libs)) $(LIBM)

$(BUILD)/watchers $(BUILD)/slices $(BUILD)/acquire: $(BUILD)/%: $(BUILD)/tests/bench/%.o
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ -lpthread

# The GPU's checks and benchmarks need the mathematics and the kernels only, so that they run on a bare machine.
$(gpu_programs): $(BUILD)/%: $(call objects,tests/bench/%.c tests/bench/gpu_scene.c) $(core_objects) $(cuda_objects)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(core_libs)) $(if $(cuda_objects),$(cuda_libs)) $(LIBM)

ifdef cuda_objects
$(BUILD)/gpu_large: $(BUILD)/tests/bench/gpu_phantom.o
$(BUILD)/tests/bench/gpu_phantom.o: tests/bench/gpu_phantom.cu tests/bench/gpu_phantom.h kernels/internal.cuh
	@mkdir -p $(@D)
	$(call say,NVCC)$(NVCC) -std=c++17 -O3 -I. $(cuda_code) -c -o $@ $<
endif

$(BUILD)/gpu_ceilings: tests/bench/gpu_ceilings.cu
	@mkdir -p $(@D)
	$(call say,NVCC)$(NVCC) -std=c++17 -O3 $(cuda_code) -o $@ $<

apt_install = { $$run apt-get install -y -qq --no-install-recommends $(1) >/dev/null 2>&1 || \
	  { $$run apt-get update -qq && DEBIAN_FRONTEND=noninteractive $$run apt-get install -y -qq --no-install-recommends $(1) >/dev/null; }; }

# Of commands or files, and of Python's modules.
install_optional = wanted=""; for pair in $(1); do command -v $${pair%%:*} >/dev/null 2>&1 || [ -e $${pair%%:*} ] || wanted="$$wanted $${pair\#\#*:}"; done; \
	for pair in $(2); do $(PYTHON) -c "import $${pair%%:*}" 2>/dev/null || wanted="$$wanted $${pair\#\#*:}"; done; \
	[ -z "$$wanted" ] && exit 0; \
	run=""; [ "$$(id -u)" = 0 ] || run="sudo -n"; \
	echo "installing:$$wanted"; \
	$(call apt_install,$$wanted) || echo "going on without$$wanted: apt-get cannot install them here" >&2

check: OPTIONAL += pg_config:libpq-dev g++:g++ /usr/include/dcmtk/dcmnet/scu.h:libdcmtk-dev
# What tests alone need comes while the programs are compiled.
for_tests := pg_ctlcluster:postgresql ip:iproute2 chromium:chromium dciodvfy:dicom3tools Orthanc:orthanc-dicomweb /usr/share/orthanc/plugins/libOrthancWebViewer.so:orthanc-webviewer promtool:prometheus systemd-analyze:systemd
modules_for_tests := matplotlib:python3-matplotlib nibabel:python3-nibabel pydicom:python3-pydicom gdcm:python3-gdcm h5py:python3-h5py olefile:python3-olefile odil:python3-odil
setup: ## install the Debian packages that are missing
	@missing=""; \
	for pair in $(COMMANDS); do command -v $${pair%%:*} >/dev/null 2>&1 || missing="$$missing $${pair##*:}"; done; \
	for pair in $(PACKAGES); do pkg-config --exists $${pair%%:*} 2>/dev/null || missing="$$missing $${pair##*:}"; done; \
	for pair in $(MODULES); do $(PYTHON) -c "import $${pair%%:*}" 2>/dev/null || missing="$$missing $${pair##*:}"; done; \
	[ -z "$$missing" ] && exit 0; \
	echo "installing:$$missing"; \
	run=""; [ "$$(id -u)" = 0 ] || run="sudo -n"; \
	if [ "$$(id -u)" != 0 ] && ! sudo -n true 2>/dev/null; then \
		echo "please type:  sudo apt-get install -y --no-install-recommends$$missing" >&2; exit 1; fi; \
	$(call apt_install,$$missing)
	@$(call install_optional,$(OPTIONAL))

for-tests:
	@$(call install_optional,$(for_tests),$(modules_for_tests))

demo: setup ## a C-arm scan posted with curl, reconstructed, its volumes coming back
	@$(MAKE) --no-print-directory -j$$(nproc) all
	@BUILD=$(BUILD) clients/curl/demo.sh

# What takes longest to compile begins first, so that nothing waits for it alone at the end.
check: setup ## every test; what cannot run here is skipped aloud
	@$(MAKE) --no-print-directory -j$$(($$(nproc) + 1)) for-tests $(filter %/project.o,$(cuda_objects)) all test-programs
	@BUILD=$(BUILD) SANITIZED=$(SANITIZED) LEAVE_OUT="$(LEAVE_OUT)" tests/run.sh

soak: setup ## the long tests: faults by the thousand, sweeps over anatomy and noise (an hour and more)
	@$(MAKE) --no-print-directory -j$$(nproc) all test-programs
	@BUILD=$(BUILD) tests/run.sh --soak

FUZZ_SECONDS ?= 10
fuzzers := $(patsubst tests/fuzz/%.c,$(BUILD)/%,$(wildcard tests/fuzz/fuzz_*.c))

# Of these a fuzz target takes what it needs.
$(BUILD)/fuzzed.a: $(call objects,$(filter-out daemon/main.c clients/cbct/main.c,$(daemon_sources) daemon/dicom/answer.c $(cbct_sources)))
	@rm -f $@
	$(call say,AR  )$(AR) qcs $@ $^

$(BUILD)/fuzz_%: $(BUILD)/tests/fuzz/fuzz_%.o $(BUILD)/fuzzed.a $(library)
	$(call say,LINK)$(CC) $(LDFLAGS) -fsanitize=fuzzer -o $@ $^ $(call pkg,--libs,$(daemon_libs) $(cbct_libs) $(proto_libs) $(core_libs)) $(LIBM)

fuzzers: $(fuzzers)

fuzz: setup ## each fuzz target for FUZZ_SECONDS=10 (needs clang)
	@command -v clang >/dev/null || { echo "make fuzz needs clang: apt-get install clang" >&2; exit 1; }
	@$(MAKE) --no-print-directory -j$$(nproc) fuzzers BUILD=$(BUILD)/fuzz CC=clang \
		SANITIZE=fuzzer-no-link,address,undefined OPENMP= CUDA=0
	@BUILD=$(BUILD)/fuzz FUZZ_SECONDS=$(FUZZ_SECONDS) tests/fuzz/run.sh

bench-phantoms: setup ## calibrations of random phantoms with right and wrong drawings, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/phantoms >&2
	@$(BUILD)/phantoms

bench-denoise: setup ## the default TV on anatomies beside the best of a sweep, a table on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/denoise >&2
	@$(BUILD)/denoise

bench-presets: setup ## time and error of each preset on a head, a wrist and an abdomen, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/presets >&2
	@$(BUILD)/presets

bench-stopping: setup ## how far from the best iteration "iterations": "auto" ends, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/stopping >&2
	@$(BUILD)/stopping

bench-methods: setup ## every method at its best on three anatomies, 26 to 200 views, three levels of noise, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/methods >&2
	@OUT=$(BUILD)/bench/methods tests/bench/methods.sh $(BUILD)/methods && cat $(BUILD)/bench/methods/methods.txt

bench-agreement: setup ## what the check of the geometry says of known scans, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/agreement >&2
	@$(BUILD)/agreement

bench-breathing: setup ## who is told to have breathed, of known scans, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/breathing >&2
	@$(BUILD)/breathing

bench-scatter: setup ## HU that scatter leaves, as it is and taken off by fitted models, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/scatter >&2
	@$(BUILD)/scatter

bench-refine: setup ## what the refinement makes of known scans, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/refine >&2
	@$(BUILD)/refine

bench-calibrate: setup ## a calibration of 400 views of 1240 x 960 pixels, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/calibrate-bench >&2
	@$(BUILD)/calibrate-bench

# RABBITCT=FILE: the real data set; else one of the same form with 60 views. RABBITCT_LOLA=PROGRAM: the public runner,
# whose LolaASM then runs beside on as many threads.
RABBITCT_SIZES ?= 256 512
bench-rabbitct: ## RabbitCT's backprojection in GUPS, with its errors in HU, on standard output
	@$(MAKE) --no-print-directory -j$$(nproc) $(BUILD)/rabbitct >&2
	@BUILD=$(BUILD) RABBITCT=$(RABBITCT) RABBITCT_LOLA=$(RABBITCT_LOLA) tests/bench/rabbitct.sh $(RABBITCT_SIZES)

bench: setup ## CPU and HTTP benchmarks, results in build/bench/
	@$(MAKE) --no-print-directory -j$$(nproc) all $(BUILD)/cpu-bench $(BUILD)/acquire $(BUILD)/watchers $(BUILD)/slices
	@BUILD=$(BUILD) tests/bench/run.sh

# Shares nothing with the project: projections of voxel objects for `make paper`.
$(BUILD)/paper-project: tests/paper/project.c
	@mkdir -p $(@D)
	$(call say,CC  )$(CC) -std=c11 -O2 -Wall -Wextra -Wpedantic $(OPENMP) -o $@ $< -lm

# PAPER=small: up to 64^3 voxels (10 minutes on two cores); PAPER=all: all; by default all with a GPU.
PAPER ?= auto
paper: MODULES += matplotlib:python3-matplotlib
paper: setup ## the study's experiments through the daemon, a report in build/paper/ (PAPER=small or all)
	@$(MAKE) --no-print-directory -j$$(nproc) all $(BUILD)/paper-project
	@OMP_WAIT_POLICY=passive $(PYTHON) tests/paper/experiments.py --build $(BUILD) --size $(PAPER) --results $(BUILD)/paper/results
	@$(PYTHON) tests/paper/report.py $(BUILD)/paper/results $(BUILD)/paper/paper

paper-report: ## docs/paper.html again, from the results that are kept in tests/paper/results
	@mkdir -p $(BUILD)/paper && $(PYTHON) tests/paper/report.py tests/paper/results $(BUILD)/paper/kept && cp $(BUILD)/paper/kept.html docs/paper.html

# A worker that can be made to fault, for the test of what becomes of that.
$(BUILD)/tests/gpu/fault.o: tests/gpu/fault.cu
	@mkdir -p $(@D)
	$(call say,NVCC)$(NVCC) -std=c++17 $(cuda_code) -c -o $@ $<
$(BUILD)/cbct-worker-faulty: $(call objects,daemon/worker.c) $(library) $(cuda_objects) $(BUILD)/tests/gpu/fault.o
	$(call say,LINK)$(CC) $(LDFLAGS) -Wl,--wrap=_Z7cuda_tvP4planP6volumePK10tv_optionsPK6cancelP5error -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(cuda_libs) $(LIBM)

ifdef cuda_objects
check-gpu: ## the CUDA backend against the CPU's, and through the daemon; skipped aloud without a GPU
	@$(MAKE) --no-print-directory -j$$(nproc) all $(BUILD)/gpu_check $(BUILD)/gpu_cards $(BUILD)/cbct-worker-faulty $(BUILD)/cbct-worker-held
	@$(BUILD)/gpu_check
	@BUILD=$(BUILD) tests/gpu/end_to_end.sh
	@BUILD=$(BUILD) tests/gpu/sanitize.sh

bench-gpu: ## times of the CUDA backend beside goals, peers, ceilings and the last kept result, in build/bench/
	@$(MAKE) --no-print-directory -j$$(nproc) all $(BUILD)/gpu_bench $(BUILD)/gpu_ceilings
	@BUILD=$(BUILD) tests/bench/gpu.sh
else
check-gpu bench-gpu:
	@echo "SKIPPED: $@ needs the CUDA backend, which is left out or cannot be built here (no nvcc with its libraries)"
endif

asan: setup ## the tests under the address and undefined-behaviour sanitizers
	@$(MAKE) --no-print-directory check SANITIZED=1 LEAVE_OUT=-study BUILD=build/asan SANITIZE=address,undefined CUDA=0

tsan: setup ## the daemon's tests under the thread sanitizer (OpenMP's runtime left out)
	@$(MAKE) --no-print-directory check SANITIZED=1 LEAVE_OUT="-study -recon -backend" BUILD=build/tsan SANITIZE=thread OPENMP= CUDA=0

lint: ## who includes whom, and the house's other rules
	@tests/lint.sh

pictures: all ## docs/page.png and docs/before-after.png, those of the README, from a real run
	@docs/pictures.sh

rooms: ## docs/rooms.svg, the picture of who includes whom
	@$(PYTHON) docs/rooms.py

python-parameters: all ## the table of parameters in clients/python/cbctd.py
	@$(BUILD)/cbct parameters --json | $(PYTHON) clients/python/parameters.py

third-party: all ## docs/third-party.md, the parts of others with version and licence
	@$(PYTHON) docs/third-party.py $(BUILD)

sbom: all ## build/sbom.json, the bill of materials (CycloneDX)
	@$(PYTHON) packages/sbom.py $(BUILD) >$(BUILD)/sbom.json.part && mv $(BUILD)/sbom.json.part $(BUILD)/sbom.json && ls $(BUILD)/sbom.json

reproducible: ## builds twice in different folders and compares programs and packages byte by byte
	@packages/reproducible.sh CUDA=$(CUDA) $(if $(cuda_objects),CUDA_ARCH="$(CUDA_ARCH)")

# For clangd and other tools. What make would run to compile each C file; CUDA's are left out, clang takes other options.
c_sources = $(shell find clients core daemon proto tests -name node_modules -prune -o -name '*.c' -print | sort)
compile_commands.json: ## how each C file is compiled, for editors
	@$(MAKE) --no-print-directory -nB V=1 $(call objects,$(filter-out $(simd_sources),$(c_sources))) $(simd_objects) | \
	awk -v folder="$(CURDIR)" '/ -c -o [^ ]+ [^ ]+\.c$$/ { gsub(/[\\"]/, "\\\\&"); \
		printf "%s{\"directory\": \"%s\", \"file\": \"%s\", \"output\": \"%s\", \"command\": \"%s\"}", \
			n++ ? ",\n" : "[\n", folder, $$NF, $$(NF - 1), $$0 } END { print "\n]" }' >$@.part && mv $@.part $@

format: ## clang-format over everything
	@clang-format -i $$(git ls-files '*.c' '*.h' '*.cu' '*.cuh')

sysconfdir ?= $(if $(filter /usr,$(prefix)),/etc,$(prefix)/etc)
docdir      = $(prefix)/share/doc/cbctd
configure   = sed 's,@prefix@,$(prefix),g;s,@sysconfdir@,$(sysconfdir),g;s,@docdir@,$(docdir),g'
# Man pages and completions are what the programs' --help says.
$(BUILD)/manual: $(programs) packages/manual.py
	$(call say,MAN )rm -rf $@ && $(PYTHON) packages/manual.py $(BUILD) $@

install: all $(BUILD)/manual ## programs, units, settings, man pages and documents under $(DESTDIR)$(prefix)
	install -D -m 755 -t $(DESTDIR)$(prefix)/bin $(programs)
	install -d $(addprefix $(DESTDIR),$(prefix)/lib/systemd/system $(prefix)/lib/tmpfiles.d $(docdir))
	install -d -m 750 $(DESTDIR)$(sysconfdir)/cbctd
	$(configure) systemd/cbctd.service.in >$(DESTDIR)$(prefix)/lib/systemd/system/cbctd.service
	$(configure) systemd/cbctd.tmpfiles.in >$(DESTDIR)$(prefix)/lib/tmpfiles.d/cbctd.conf
	install -D -m 644 -t $(DESTDIR)$(prefix)/lib/systemd/system systemd/cbctd.socket
	install -D -m 644 systemd/cbctd.sysusers $(DESTDIR)$(prefix)/lib/sysusers.d/cbctd.conf
	install -m 644 -t $(DESTDIR)$(docdir) README.md docs/operation.md docs/fleet.md systemd/cbctd.sbatch systemd/cbctd-alerts.yaml systemd/cbctd-dashboard.json
	STATE_DIRECTORY=/var/lib/cbctd $(BUILD)/cbctd --print-config | sed 's/^[^#]/#&/' >$(DESTDIR)$(docdir)/cbctd.conf
	install -D -m 644 -t $(DESTDIR)$(prefix)/share/man/man1 $(BUILD)/manual/man/cbct.1
	install -D -m 644 -t $(DESTDIR)$(prefix)/share/man/man8 $(addprefix $(BUILD)/manual/man/,cbctd.8 cbct-worker.8 cbct-dicom.8)
	install -D -m 644 -t $(DESTDIR)$(prefix)/share/bash-completion/completions $(BUILD)/manual/completions/bash/cbct
	ln -sf cbct $(DESTDIR)$(prefix)/share/bash-completion/completions/cbctd
	install -D -m 644 -t $(DESTDIR)$(prefix)/share/zsh/site-functions $(BUILD)/manual/completions/zsh/_cbct
	install -D -m 644 -t $(DESTDIR)$(prefix)/share/fish/vendor_completions.d $(BUILD)/manual/completions/fish/cbct.fish
	[ -e $(DESTDIR)$(sysconfdir)/cbctd/cbctd.conf ] || \
		install -m 640 $(DESTDIR)$(docdir)/cbctd.conf $(DESTDIR)$(sysconfdir)/cbctd/cbctd.conf

# The package for every machine has the worker without CUDA; the one for cards has the other as cbct-worker-cuda.
$(BUILD)/packaged/cbct-worker: $(call objects,daemon/worker.c) $(library)
	@mkdir -p $(@D)
	$(call say,LINK)$(CC) $(LDFLAGS) -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(LIBM)
$(BUILD)/packaged/cbct-worker-cuda: $(call objects,daemon/worker.c) $(library) $(cuda_objects)
	@mkdir -p $(@D)
	$(call say,LINK)$(CC) $(LDFLAGS) -Wl,-rpath,'$$ORIGIN/../lib/cbctd' -o $@ $^ $(call pkg,--libs,$(proto_libs) $(core_libs)) $(cuda_paths) -lcufft -lcudart -lstdc++ $(LIBM)

VERSION ?= $(shell sed -n 's/^.define CBCT_VERSION "\(.*\)"/\1/p' proto/version.h)
deb: all $(BUILD)/manual $(BUILD)/packaged/cbct-worker $(if $(cuda_objects),$(BUILD)/packaged/cbct-worker-cuda) ## Debian packages in build/deb/, another one for NVIDIA cards where CUDA is built
	@rm -rf $(BUILD)/packaged/root && $(MAKE) --no-print-directory -o all install DESTDIR=$(abspath $(BUILD)/packaged/root) prefix=/usr >$(BUILD)/packaged/log
	@install -m 755 $(BUILD)/packaged/cbct-worker $(BUILD)/packaged/root/usr/bin/cbct-worker
	@packages/deb.sh $(BUILD)/packaged/root $(VERSION) $(BUILD)/deb $(if $(cuda_objects),$(BUILD)/packaged/cbct-worker-cuda)

# A mirror of the base image, or one made by debootstrap: make container CONTAINER_BASE=localhost/bookworm
CONTAINER_BASE ?= docker.io/library/debian:bookworm-slim
container: deb ## an OCI image of the package, with buildah, podman or docker
	@for tool in "buildah build" "podman build" "docker build"; do command -v $${tool%% *} >/dev/null && break; tool=; done; \
	[ -n "$$tool" ] || { echo "make container needs buildah, podman or docker: apt-get install buildah" >&2; exit 1; }; \
	case $$tool in docker*) ;; *) tool="$$tool --format docker" ;; esac; \
	$$tool -q -f packages/Containerfile --build-arg BASE=$(CONTAINER_BASE) -t cbctd:$(VERSION) $(BUILD)/deb

# A tarball's programs look for libraries beside them (RPATH, which the libraries inherit); glibc is the system's.
bundle: prefix = /opt/cbctd
bundle: docdir = /opt/cbctd
bundle: ## a tarball that runs on a machine with a driver only, unpacked as /opt/cbctd
	@$(MAKE) --no-print-directory BUILD=$(BUILD)/bundled BUNDLE=1 all
	@set -e; to=$(BUILD)/bundle/cbctd; rm -rf $(BUILD)/bundle; mkdir -p $$to/bin $$to/lib; \
	for p in $(notdir $(programs)); do cp $(BUILD)/bundled/$$p $$to/bin/; strip $$to/bin/$$p; done; \
	ldd $$to/bin/* | awk '/=> \// { print $$3 }' | sort -u | \
	grep -vE '/(libc|libm|libdl|libpthread|librt|libresolv|libcuda)\.so|/ld-linux' | xargs cp -L -t $$to/lib; \
	cp README.md docs/operation.md systemd/cbctd.socket $$to/; mkdir $$to/etc $$to/etc/cbctd; $(configure) systemd/cbctd.service.in >$$to/cbctd.service; \
	$(configure) systemd/cbctd.sysusers >$$to/sysusers.conf; STATE_DIRECTORY=/var/lib/cbctd $(BUILD)/bundled/cbctd --print-config | sed 's/^[^#]/#&/' >$$to/etc/cbctd/cbctd.conf; tar -C $(BUILD)/bundle -cf - cbctd | zstd -q -T0 -f -o $(BUILD)/cbctd.tar.zst; \
	ls -l $(BUILD)/cbctd.tar.zst

clean: ## removes build/
	rm -rf $(BUILD)

help: ## this list
	@awk -F ':.*## ' '/^[a-z_.-]+:.*## /{printf "  make %-21s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

.PHONY: all test-programs for-tests again setup demo check soak fuzz fuzzers paper paper-report bench bench-agreement bench-breathing bench-scatter bench-refine bench-calibrate bench-phantoms bench-denoise bench-presets bench-stopping bench-methods check-gpu bench-gpu asan tsan lint format rooms pictures third-party compile_commands.json install deb container sbom reproducible clean help
.SECONDARY:
-include $(shell find $(BUILD) -path $(BUILD)/test -prune -o -type f -name '*.d' -print 2>/dev/null)
