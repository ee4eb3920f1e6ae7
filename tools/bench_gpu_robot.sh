#!/usr/bin/env bash
# Measures the robot's worlds in MJX-Warp on a GPU, the most wanted figures first: bench_gpu_robot.sh [FILE] [LIMIT]
# FILE (default: robot-gpu.jsonl) gets a line of JSON for each case as it is measured, or where it failed. Each case is a
# process of its own: in one process, a second engine has hung. LIMIT (default: 600) is after how many seconds no other begins.
set -u
cd "$(dirname "$0")/.."
file=${1:-robot-gpu.jsonl} limit=${2:-600} python=${PYTHON:-python3} engine='{}'
export XLA_PYTHON_CLIENT_MEM_FRACTION=${XLA_PYTHON_CLIENT_MEM_FRACTION:-0.55} PYTHONUNBUFFERED=1
measure() { # SECONDS CASE
  local code
  if [ "$SECONDS" -ge "$limit" ]; then
    echo "{\"left_out\": $2}" >> "$file"
    return 0
  fi
  timeout "$1" "$python" -m bson.bench_warp "$engine" "$2" 2> "$file.err" | grep --line-buffered '^{' | tee -a "$file"
  code=${PIPESTATUS[0]}
  [ "$code" = 0 ] || "$python" - "$code" "$file.err" "$2" >> "$file" <<'PY'
import json, sys
code, err, case = sys.argv[1:]
why = open(err, errors="replace").read()[-1500:]
print(json.dumps({"failed": json.loads(case), "code": int(code), "why": why}))
PY
  return "$code"
}
# The first case also compiles Warp's kernels, about a minute.
measure 200 '{"sensor": "lidar2d", "seconds": 4}' || engine='{"graph": false}'
measure 120 '{"sensor": "none", "seconds": 4}'
measure 150 '{"train": true, "seconds": 6}'
measure 120 '{"sensor": "camera", "worlds": 1024, "seconds": 4}'
measure 120 '{"sensor": "lidar3d", "worlds": 1024, "seconds": 4}'
measure 120 '{"sensor": "none", "worlds": 16384, "seconds": 4}'
measure 120 '{"sensor": "lidar2d", "worlds": 16384, "seconds": 4}'
measure 150 '{"score": "tac"}'
measure 150 '{"score": "ppo"}'
measure 120 '{"sensor": "none", "seconds": 4, "engine": {"solver": "cg", "iterations": 20}}'
measure 120 '{"sensor": "none", "seconds": 4, "engine": {"tolerance": 1e-6}}'
measure 120 '{"sensor": "lidar2d", "worlds": 1024, "seconds": 4}'
measure 120 '{"train": true, "worlds": 16384, "seconds": 6}'
measure 120 '{"sensor": "lidar2d", "people": 50, "seconds": 4}'
