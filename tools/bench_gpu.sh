#!/usr/bin/env bash
# Measures crowds on a GPU, most wanted first: each case is a process of its own with a time limit, and its line goes to
# OUT/bench.jsonl as it comes; OUT/bench.log has what each printed.
#
#   tools/bench_gpu.sh OUT [CASE...]     # cases by name, all by default; see below
#
# PYTHON (python3), LIMIT (120 s a case), WORLDS (1024), SECONDS_EACH (2) and ENGINE (warp, with options or without) can be
# set in the environment.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${1:?usage: tools/bench_gpu.sh OUT [CASE...]}
shift
python=${PYTHON:-python3} limit=${LIMIT:-120} worlds=${WORLDS:-1024} seconds=${SECONDS_EACH:-2} engine=${ENGINE:-warp}
many=$((4 * worlds))
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1 MUJOCO_GL=${MUJOCO_GL:-disable}
memory=${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.55}  # JAX's share; the rest is Warp's

# What `macid bench` is given. @ stands for the engine, @A=B,C=D for it with these options.
declare -A cases=(
  [rollout50]="@ --levels 2 --worlds $worlds --only rollout"
  [rollout200]="@ --levels 4 --worlds $worlds --only rollout"
  [training50]="@ --levels 2 --worlds $worlds --preset gpu --rollout 25 --only training"
  [rollout50-many]="@ --levels 2 --worlds $many --only rollout"
  [training50-many]="@ --levels 2 --worlds $many --preset gpu --rollout 25 --only training"
  [profile50]="@ --levels 2 --worlds $worlds --preset gpu --rollout 25 --only rollout --profile"
  [profile200]="@ --levels 4 --worlds $worlds --preset gpu --rollout 25 --only rollout --profile"
  [profile50-many]="@ --levels 2 --worlds $many --preset gpu --rollout 25 --only rollout --profile"
  [rollout50-cg]="@solver=cg --levels 2 --worlds $worlds --only rollout"
  [rollout50-loop]="@until_done=0,iterations=6 --levels 2 --worlds $worlds --only rollout"
  [rollout50-room]="@contacts=1 --levels 2 --worlds $worlds --only rollout"
  [rollout200-newton]="@solver=newton --levels 4 --worlds $worlds --only rollout"
  [rollout200-loop]="@until_done=0,iterations=16 --levels 4 --worlds $worlds --only rollout"
  [levels]="@ --levels 1 2 3 4 --worlds 64 $worlds --preset gpu --rollout 25"
  [mjx]="--engine mjx --levels 2 --worlds 512 --only rollout"
  [native]="--engine native --levels 2 --worlds 64"
)
order=(warm rollout50 rollout200 training50 rollout50-many profile50 profile200 rollout50-cg rollout200-newton
  rollout50-loop rollout200-loop training50-many rollout50-room profile50-many levels mjx native)
[ $# -gt 0 ] && order=("$@")
for name in "${order[@]}"; do
  if [ "$name" != warm ] && [ -z "${cases[$name]:-}" ]; then
    echo "bench_gpu: unknown case '$name'. Choose among: warm ${!cases[*]}" >&2
    exit 2
  fi
done
mkdir -p "$out"

# The flags $1 with the engine in the place of @.
given() {
  local first=${1%% *} options
  [[ $first != @* ]] && echo "$1" && return
  options=${first#@}
  if [ -n "$options" ]; then
    [[ $engine == *:* ]] && options=",$options" || options=":$options"
  fi
  echo "--engine $engine$options ${1#"$first"}"
}

# Warp compiles its kernels once on a machine, for each number of people and solver: side by side.
warm() {
  local name
  for name in rollout50 rollout200 rollout50-cg rollout200-newton; do
    # shellcheck disable=SC2046
    XLA_PYTHON_CLIENT_MEM_FRACTION=0.1 timeout -k 5 "$limit" "$python" -m macid.cli bench $(given "${cases[$name]}") \
      --worlds 2 --rollout 1 --seconds 0.01 > "$out/warm-$name.log" 2>&1 &
  done
  wait
  tail -qn 1 "$out"/warm-*.log
}

measure() {
  local name=$1 begin code platform=()
  begin=$(date +%s)
  [ "$name" = native ] && platform=(env JAX_PLATFORMS=cpu)
  rm -f "$out/$name.json"
  # shellcheck disable=SC2046
  XLA_PYTHON_CLIENT_MEM_FRACTION=$memory timeout -k 5 "$limit" "${platform[@]}" "$python" -m macid.cli bench \
    $(given "${cases[$name]}") --seconds "$seconds" --out "$out/$name.json" > "$out/$name.log" 2>&1
  code=$?
  {
    echo "== $name: $(given "${cases[$name]}") (exit code $code, $(($(date +%s) - begin)) s)"
    tail -n 30 "$out/$name.log"
  } | tee -a "$out/bench.log"
  if [ "$code" = 0 ]; then
    "$python" -c 'import json, sys
for row in json.load(open(sys.argv[1])):
    print(json.dumps({"case": sys.argv[2], **row}))' "$out/$name.json" "$name" >> "$out/bench.jsonl"
  else
    printf '{"case": "%s", "exit_code": %d}\n' "$name" "$code" >> "$out/bench.jsonl"
  fi
  return "$code"
}

for name in "${order[@]}"; do
  if [ "$name" = warm ]; then
    warm 2>&1 | tee -a "$out/bench.log"
  elif ! measure "$name" && [ "$name" = rollout50 ] && [ "$engine" = warp ]; then
    for engine in warp:graph=call warp:graph=none; do  # for what follows, too
      measure rollout50 && break
    done
  fi
done
