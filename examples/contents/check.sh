#!/usr/bin/env bash
# Runs an image of private contents as the cluster does, and looks at what it copied: `check.sh IMAGE [V1|V2 [ROUTES]]`.
# It leaves the copy in ./contents, which examples/participants/try.sh takes as --contents.
set -euo pipefail

image=${1:?usage: check.sh IMAGE [V1|V2 [ROUTES]]}
version=${2:-V2}
routes=${3:-data/routes_testing.xml}
out=./contents
mkdir -p "$out"/{leaderboard,scenario_runner,CARLA}
out=$(realpath "$out")
chmod 0777 "$out"/{leaderboard,scenario_runner,CARLA}

# The default of evaluation.carla.contents.command.
script='set -e
: "${LEADERBOARD_ROOT:?}" "${SCENARIO_RUNNER_ROOT:?}" "${CARLA_PYTHON_API_ROOT:?}"
cp -r ${LEADERBOARD_ROOT}/* /tmp/leaderboard/
cp -r ${SCENARIO_RUNNER_ROOT}/* /tmp/scenario_runner/
cp -r ${CARLA_PYTHON_API_ROOT}/* /tmp/CARLA/
'
docker run --rm --network none --cap-drop ALL --security-opt no-new-privileges --platform linux/amd64 --entrypoint /bin/bash \
  --volume "$out/leaderboard:/tmp/leaderboard" --volume "$out/scenario_runner:/tmp/scenario_runner" --volume "$out/CARLA:/tmp/CARLA" \
  "$image" -c "$script"

needed=("leaderboard/leaderboard/leaderboard_evaluator.py" "leaderboard/$routes" scenario_runner/srunner CARLA/PythonAPI/carla/agents)
[ "$version" = V2 ] || needed+=(leaderboard/data/all_towns_traffic_scenarios_private.json)
faults=0
for file in "${needed[@]}"; do
  [ -e "$out/$file" ] || { echo "missing: $file"; faults=1; }
done
unreadable=$(find "$out" \( -type f ! -perm -o=r -o -type d ! -perm -o=rx \) -print)
[ -z "$unreadable" ] || { echo "not readable for everybody:"; echo "$unreadable"; faults=1; }

# Pairs get their routes by position and report them by id.
[ ! -e "$out/leaderboard/$routes" ] || python3 - "$out/leaderboard/$routes" <<'PYTHON' || faults=1
import sys
from xml.etree import ElementTree

ids = [route.get("id") for route in ElementTree.parse(sys.argv[1]).getroot().iter("route")]
print(f"{len(ids)} routes: evaluation.carla.routes of the Leaderboard")
wrong = [f"the route at position {at} has the id {found}" for at, found in enumerate(ids) if found != str(at)]
print("\n".join(wrong[:5]), end="\n" if wrong else "")
sys.exit(bool(wrong))
PYTHON
[ "$faults" = 0 ] && echo "The contents are complete." || exit 1
