#!/usr/bin/env bash
# Trains all methods of Table II on a GPU, several seeds of each at once, within a total time, and keeps in OUT/policies what
# tools/reproduce_tables.py takes: policies, their recipes and their curves.
#
#   tools/train_gpu.sh OUT [SECONDS]      # 600 s in all by default
#   tools/reproduce_tables.py --policies OUT/policies --no-train --seeds 7 --out tables
#
# PYTHON (python3), SEEDS (7), STEPS (30e6, agent-steps of each), METHODS, TOGETHER (2 trainings at a time), MORE (further
# flags of macid train) and ENGINE (warp) can be set in the environment. What is not done in time leaves no policy; its
# checkpoint is in OUT/runs, and the same command with MORE=--resume goes on there.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${1:?usage: tools/train_gpu.sh OUT [SECONDS]}
seconds=${2:-600}
python=${PYTHON:-python3} seeds=${SEEDS:-7} steps=${STEPS:-30e6} together=${TOGETHER:-2} engine=${ENGINE:-warp}
methods=${METHODS:-macid ipo copo macid-touch macid-tri mfpo}
runs=${RUNS:-$out/runs}
mkdir -p "$out/policies" "$runs"
export PYTHONPATH=$PWD${PYTHONPATH:+:$PYTHONPATH} PYTHONUNBUFFERED=1 MUJOCO_GL=${MUJOCO_GL:-disable}
export XLA_PYTHON_CLIENT_MEM_FRACTION=${XLA_PYTHON_CLIENT_MEM_FRACTION:-$("$python" -c "print(0.55 / $together)")}
end=$(($(date +%s) + seconds))

train() {
  local left=$((end - $(date +%s)))
  [ "$left" -lt 20 ] && echo "$1: no time left" && return
  # Ctrl-C's signal, which jobs in the background else ignore, so that a checkpoint is kept.
  # shellcheck disable=SC2086
  timeout -s INT -k 15 "$left" env --default-signal=INT "$python" -m macid.cli train --engine "$engine" --method "$1" --seeds "$seeds" \
    --agent-steps "$steps" ${MORE:-} --out "$runs" > "$out/$1.log" 2>&1
  echo "$1: exit code $?, at $((seconds - (end - $(date +%s)))) s: $(grep agent-steps/s "$out/$1.log" | tail -n 1)"
  for folder in "$runs/$1"-*/; do
    if [ -f "$folder/policy.npz" ]; then
      name=$(basename "$folder")
      cp "$folder/policy.npz" "$out/policies/$name.npz"
      cp "$folder/policy.json" "$out/policies/$name.json"
      cp "$folder/curve.csv" "$out/policies/$name.csv"
    fi
  done
}

for method in $methods; do
  while [ "$(jobs -rp | wc -l)" -ge "$together" ]; do wait -n; done
  train "$method" &
done
wait
ls "$out/policies"
