#!/usr/bin/env bash
# All that the docs want to know of a GPU, in at most 25 minutes: agreement with the CPU, rates and memory, the paper's
# table, train steps, kernels, a short training. The most important comes first, and everything is written as it comes,
# so a run that is cut off loses nothing. The first part compiles all programs side by side on all cores, untimed.
#
#   benchmarks/gpu.sh                         # results in $OUT, or ./gpu_results
#   benchmarks/gpu.sh results                 # ... in ./results
#   PYTHON=python3.12 benchmarks/gpu.sh       # with this Python, which has jax with CUDA and rewax's dependencies
#   QUICK=1 benchmarks/gpu.sh                 # tiny sizes on a CPU: does every part run to its end?
#   CACHE=/tmp/c PARTS=table benchmarks/gpu.sh  # one part; compiled programs are kept for the next call
#
# Without PYTHON it makes a virtual environment and installs into it, if pip can reach an index; else it takes python3.
# BUDGET: seconds in all (default 1500; QUICK 3600, for busy machines). PARTS: which parts (default: all, in the order below).
set -u
cd "$(dirname "$0")/.." || exit 1
OUT=${1:-${OUT:-gpu_results}}
BUDGET=${BUDGET:-$([ -n "${QUICK:-}" ] && echo 3600 || echo 1500)}
QUICK=${QUICK:-}
PARTS=${PARTS:-compile agreement table step train_steps profile scaling training}
TASKS="RollingFlat AntRun HandFlip FluidMove SoftJumper HandReorient GripperLift SteerFloat"
mkdir -p "$OUT" && OUT=$(cd "$OUT" && pwd) || exit 1
WORK=$(mktemp -d)
trap 'rm -rf "$WORK"' EXIT
BEGAN=$SECONDS
export PYTHONUNBUFFERED=1 PYTHONPATH="$PWD:$PWD/benchmarks${PYTHONPATH:+:$PYTHONPATH}" TF_CPP_MIN_LOG_LEVEL=2
export JAX_COMPILATION_CACHE_DIR=${CACHE:-$WORK/cache} XLA_PYTHON_CLIENT_PREALLOCATE=false
unset JAX_PLATFORMS  # both a GPU and the CPU that it is compared with
[ -n "$QUICK" ] && export JAX_PLATFORMS=cpu

say() { echo "[$((SECONDS - BEGAN)) s] $*" | tee -a "$OUT/log.txt"; }

# part NAME SECONDS FILE COMMAND...: runs it for at most so long, its output appended to the file as it comes
part() {
    local name=$1 limit=$2 file=$OUT/$3 left=$((BUDGET - SECONDS + BEGAN)) began=$SECONDS code
    shift 3
    case " $PARTS " in *" ${name%%:*} "*) ;; *) return ;; esac
    [ "$left" -lt "$limit" ] && limit=$left
    if [ "$limit" -lt 5 ]; then say "$name: left out, the budget of $BUDGET s is spent"; return; fi
    echo "\$ $*" >>"$file"
    timeout -k 5 "$limit" "$@" >>"$file" 2>&1
    code=$?
    FAILED=$((FAILED + (code != 0)))
    say "$name: exit code $code after $((SECONDS - began)) s ($([ $code = 124 ] && echo "cut off at $limit s; ")${file##*/})"
    return $code
}

# compile_all COMMAND...: runs the commands side by side, one per core, for the compiled programs that they leave behind
compile_all() {
    printf '%s\n' "$@" >"$WORK/commands"
    part compile 300 compile.txt xargs -a "$WORK/commands" -P "$(nproc)" -I{} bash -c 'b=$SECONDS; {} >"$0/$$" 2>&1; echo "$?, $((SECONDS - b)) s: {}"' "$WORK"
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then return; fi
    PYTHON=python3
    [ -n "$QUICK" ] && return
    local cuda=cuda12 driver
    driver=$(nvidia-smi --query-gpu=driver_version --format=csv,noheader 2>/dev/null | head -1 | cut -d. -f1)
    [ "${driver:-0}" -ge 580 ] && cuda=cuda13
    if timeout 30 python3 -m pip download -q --no-deps -d "$WORK" tyro >/dev/null 2>&1 && python3 -m venv "$WORK/venv"; then
        if timeout 400 "$WORK/venv/bin/pip" install -q "jax[$cuda]>=0.10.1,!=0.10.2,!=0.11.0" -e . >>"$OUT/log.txt" 2>&1; then
            PYTHON=$WORK/venv/bin/python
            return
        fi
        say "installation failed: $PYTHON is used as it is"
    fi
}

FAILED=0
find_python
say "python: $("$PYTHON" -c 'import sys; print(sys.executable, sys.version.split()[0])' 2>&1)"
nvidia-smi >>"$OUT/log.txt" 2>&1
if ! timeout 120 "$PYTHON" -c 'import jax, flax, optax, distrax, tyro, rewax; print("jax", jax.__version__, jax.devices())' >>"$OUT/log.txt" 2>&1; then
    tail -3 "$OUT/log.txt"
    say "$PYTHON lacks something: set PYTHON to one that has jax with CUDA and the dependencies in pyproject.toml"
    exit 1
fi
tail -1 "$OUT/log.txt"
if [ -z "$QUICK" ] && ! timeout 120 "$PYTHON" -c 'import jax; assert jax.default_backend() == "gpu"' >>"$OUT/log.txt" 2>&1; then
    say "jax finds no GPU here: give a Python with jax[cuda12] or jax[cuda13] as PYTHON, or QUICK=1 to try the script"
    exit 1
fi

if [ -n "$QUICK" ]; then
    compile_all "$PYTHON benchmarks/speed.py --worker forward:RollingFlat:small --repeats 1"
    part agreement 600 agreement.txt "$PYTHON" benchmarks/gpu_agreement.py --tasks RollingFlat --scale small --warm-up 2
    part step:RollingFlat 300 step.txt "$PYTHON" benchmarks/speed.py --worker forward:RollingFlat:small --repeats 2
    part scaling 300 scaling.txt "$PYTHON" benchmarks/scaling.py --envs 1 2 --particles 1000 --particles-per-env 500 --substeps 4 --repeats 1 --out "$OUT/scaling"
    part table 300 table.txt "$PYTHON" benchmarks/gpu_table.py --particles 2500 --envs 1 --repeats 1 --no-backward
    part train_steps:AntRun 900 train_steps.txt "$PYTHON" benchmarks/speed.py --worker train_step:AntRun:small --repeats 1
    part profile 300 profile.txt "$PYTHON" benchmarks/gpu_profile.py --what forward --scale small --num-envs 1 --top 3
    part training 900 training.txt "$PYTHON" -m rewax train --env RollingFlat --scale small --run-dir "$WORK/run" --sapo.num-iterations 2 --train.num-eval-episodes 2 --train.no-plots
else
    commands=()
    for task in $TASKS; do commands+=("$PYTHON benchmarks/speed.py --worker train_step:$task:paper --repeats 1"); done
    for envs in 1 2 4 8 16 32; do commands+=("$PYTHON benchmarks/gpu_table.py --repeats 1 --envs $envs"); done
    for pass in forward backward; do commands+=("$PYTHON benchmarks/speed.py --worker $pass:RollingFlat:paper --num-envs 32 --repeats 1"); done
    beside=()
    for task in RollingFlat AntRun SoftJumper FluidMove HandFlip; do  # compares values, so the others may run beside it
        part "agreement:$task" 300 agreement.txt "$PYTHON" benchmarks/gpu_agreement.py --tasks "$task" &
        beside+=($!)
    done
    compile_all "${commands[@]}"
    for pid in "${beside[@]}"; do
        wait "$pid" || FAILED=$((FAILED + 1))  # a part beside the script counts in a shell of its own
    done
    part table 240 table.txt "$PYTHON" benchmarks/gpu_table.py
    for pass in forward backward; do
        part "step:$pass" 100 step.txt "$PYTHON" benchmarks/speed.py --worker "$pass:RollingFlat:paper" --num-envs 32 --repeats 5
    done
    for task in $TASKS; do
        part "train_steps:$task" 150 train_steps.txt "$PYTHON" benchmarks/speed.py --worker "train_step:$task:paper" --repeats 3
    done
    part profile:RollingFlat 100 profile.txt "$PYTHON" benchmarks/gpu_profile.py
    part profile:AntRun 100 profile.txt "$PYTHON" benchmarks/gpu_profile.py --what train_step --task AntRun
    part scaling 300 scaling.txt "$PYTHON" benchmarks/scaling.py --out "$OUT/scaling"
    part training 240 training.txt "$PYTHON" -m rewax train --env RollingFlat --scale small --run-dir "$WORK/run" --train.no-plots
fi
[ -f "$WORK/run/metrics.csv" ] && cp "$WORK/run/metrics.csv" "$OUT/training.csv"
say "done, $FAILED parts failed or were cut off; results in $OUT"
exit $((FAILED > 0))
