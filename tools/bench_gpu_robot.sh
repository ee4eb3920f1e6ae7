#!/usr/bin/env bash
# Measures the robot's worlds in MJX-Warp on a GPU, the most wanted figures first: bench_gpu_robot.sh [FILE] [LIMIT]
# FILE (default: robot-gpu.jsonl) gets a line of JSON for each case as it is measured, and one for each group of cases, a
# process of its own, that failed. LIMIT (default: 600) is after how many seconds no other group begins.
set -u
cd "$(dirname "$0")/.."
file=${1:-robot-gpu.jsonl} limit=${2:-600} python=${PYTHON:-python3} engine='{}'
export XLA_PYTHON_CLIENT_MEM_FRACTION=${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.55} PYTHONUNBUFFERED=1
group() { # SECONDS CASE...
  local seconds=$1 code
  shift
  if [ "$SECONDS" -ge "$limit" ]; then
    echo "{\"left_out\": [$(IFS=,; echo "$*")]}" >> "$file"
    return 0
  fi
  timeout "$seconds" "$python" -m bson.bench_warp "$engine" "$@" 2> "$file.err" | grep --line-buffered '^{' | tee -a "$file"
  code=${PIPESTATUS[0]}
  [ "$code" = 0 ] || "$python" - "$code" "$file.err" "$@" >> "$file" <<'PY'
import json, sys
code, err, *cases = sys.argv[1:]
why = open(err, errors="replace").read()[-1500:]
print(json.dumps({"failed": [json.loads(case) for case in cases], "code": int(code), "why": why}))
PY
  return "$code"
}
# The first case also compiles Warp's kernels, about a minute.
group 200 '{"sensor": "lidar2d", "seconds": 4}' '{"sensor": "none", "seconds": 4}' || engine='{"graph": false}'
group 150 '{"train": true, "seconds": 6}'
group 150 '{"sensor": "camera", "worlds": 1024, "seconds": 4}' '{"sensor": "lidar3d", "worlds": 2048, "seconds": 4}'
group 150 '{"score": "tac"}' '{"score": "ppo"}'
group 150 '{"sensor": "none", "worlds": 16384, "seconds": 4}' '{"sensor": "lidar2d", "worlds": 16384, "seconds": 4}'
group 120 '{"sensor": "none", "seconds": 4, "engine": {"solver": "cg", "iterations": 20}}'
group 120 '{"sensor": "none", "seconds": 4, "engine": {"tolerance": 1e-6}}'
group 120 '{"sensor": "none", "worlds": 1024, "seconds": 4}' '{"sensor": "lidar2d", "worlds": 1024, "seconds": 4}'
group 120 '{"train": true, "worlds": 16384, "seconds": 6}'
group 150 '{"sensor": "lidar2d", "people": 50, "seconds": 4}'
