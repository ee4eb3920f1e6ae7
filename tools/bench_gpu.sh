#!/usr/bin/env bash
# Measures crowds on a GPU, most wanted first: each case is a process of its own with a time limit, and its line goes to
# OUT/bench.jsonl as it comes; OUT/bench.log has what each printed.
#
#   tools/bench_gpu.sh OUT [CASE...]     # cases by name, all by default; see below
#
# PYTHON (python3), LIMIT (120 s a case), WORLDS (1024), SECONDS_EACH (2), ENGINE (warp) can be set in the environment.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${1:?usage: tools/bench_gpu.sh OUT [CASE...]}
shift
mkdir -p "$out"
python=${PYTHON:-python3} limit=${LIMIT:-120} worlds=${WORLDS:-1024} seconds=${SECONDS_EACH:-2} engine=${ENGINE:-warp}
many=$((4 * worlds))
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1
export XLA_PYTHON_CLIENT_MEM_FRACTION=${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.55}  # the rest is Warp's

with() { if [[ $engine == *:* ]]; then echo "$engine,$1"; else echo "$engine:$1"; fi; }

declare -A cases=(
  [rollout50]="--engine $engine --levels 2 --worlds $worlds --only rollout"
  [rollout200]="--engine $engine --levels 4 --worlds $worlds --only rollout"
  [training50]="--engine $engine --levels 2 --worlds $worlds --preset gpu --rollout 25 --only training"
  [rollout50-many]="--engine $engine --levels 2 --worlds $many --only rollout"
  [profile50]="--engine $engine --levels 2 --worlds $worlds --preset gpu --rollout 25 --profile"
  [profile200]="--engine $engine --levels 4 --worlds $worlds --preset gpu --rollout 25 --profile"
  [profile50-many]="--engine $engine --levels 2 --worlds $many --preset gpu --rollout 25 --profile"
  [rollout50-cg]="--engine $(with solver=cg,iterations=16) --levels 2 --worlds $worlds --only rollout"
  [rollout50-loop]="--engine $(with until_done=0,iterations=6) --levels 2 --worlds $worlds --only rollout"
  [rollout200-newton]="--engine $(with solver=newton) --levels 4 --worlds $worlds --only rollout"
  [rollout200-loop]="--engine $(with until_done=0,iterations=16) --levels 4 --worlds $worlds --only rollout"
  [rollout50-call]="--engine $(with graph=call) --levels 2 --worlds $worlds --only rollout"
  [rollout50-none]="--engine $(with graph=none) --levels 2 --worlds $worlds --only rollout"
  [levels]="--engine $engine --levels 1 2 3 4 --worlds 64 $worlds --preset gpu --rollout 25"
  [mjx]="--engine mjx --levels 2 --worlds 512 --only rollout"
  [native]="--engine native --levels 2 --worlds 64"
)
order=(rollout50 rollout200 training50 rollout50-many profile50 profile200 rollout50-cg rollout200-newton rollout50-loop
  rollout200-loop profile50-many levels mjx native)
[ $# -gt 0 ] && order=("$@")

for name in "${order[@]}"; do
  if [ -z "${cases[$name]:-}" ]; then
    echo "bench_gpu: unknown case '$name'. Choose among: ${!cases[*]}" >&2
    exit 2
  fi
done
for name in "${order[@]}"; do
  begin=$(date +%s)
  platform=()
  [ "$name" = native ] && platform=(env JAX_PLATFORMS=cpu)
  # shellcheck disable=SC2086
  timeout -k 5 "$limit" "${platform[@]}" "$python" -m macid.cli bench ${cases[$name]} --seconds "$seconds" \
    --out "$out/$name.json" > "$out/$name.log" 2>&1
  code=$?
  {
    echo "== $name: ${cases[$name]} (exit code $code, $(($(date +%s) - begin)) s)"
    tail -n 30 "$out/$name.log"
  } | tee -a "$out/bench.log"
  if [ -f "$out/$name.json" ]; then
    "$python" -c 'import json, sys
for row in json.load(open(sys.argv[1])):
    print(json.dumps({"case": sys.argv[2], **row}))' "$out/$name.json" "$name" >> "$out/bench.jsonl"
  else
    printf '{"case": "%s", "exit_code": %d}\n' "$name" "$code" >> "$out/bench.jsonl"
  fi
done
