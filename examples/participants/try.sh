#!/usr/bin/env bash
# Runs a submission's image at home as one simulator-agent pair of the cluster runs it: the operator's own runner, the same command,
# variables and mounts, no network, no capabilities. docs/participants.md has the preparations; `try.sh --help` lists the options.
set -euo pipefail

usage() {
  cat <<'TEXT'
usage: try.sh --runner FILE --contents FOLDER [options] IMAGE

--runner FILE       leaderboard-runner, copied out of the operator's image
--contents FOLDER   has the folders leaderboard, scenario_runner and CARLA, as the contents image has them
--simulator IMAGE   image of CARLA's server (carlasim/carla:0.9.15)
--version V1|V2     Leaderboard 1.0, or 2.0 and later (V2)
--track NAME        CHALLENGE_TRACK_CODENAME (SENSORS)
--routes FILE       in the contents, below leaderboard (data/routes_devtest.xml)
--scenarios FILE    the same, V1 only (data/all_towns_traffic_scenarios_public.json)
--subset FIRST-LAST routes to drive (0-0)
--repetitions N     of each route (1)
--idle SECONDS      an agent that prints nothing for so long is stopped (800)
--memory SIZE       memory limit of the agent (none)
--gpus WHICH        `docker run --gpus`, for both (all); none: no GPU
--out FOLDER        results and logs (./try-results); a resume if it has results
TEXT
}

fail() {
  echo "try.sh: $1" >&2
  exit 2
}

runner='' contents='' simulator=carlasim/carla:0.9.15 version=V2 track=SENSORS
routes=data/routes_devtest.xml scenarios=data/all_towns_traffic_scenarios_public.json
subset=0-0 repetitions=1 idle=800 memory='' gpus=all out=./try-results image=''
while [ $# -gt 0 ]; do
  case "$1" in
    --help) usage; exit 0 ;;
    --runner | --contents | --simulator | --version | --track | --routes | --scenarios | --subset | --repetitions | --idle | --memory | --gpus | --out)
      [ $# -ge 2 ] || fail "$1 needs a value"
      printf -v "${1#--}" '%s' "$2"
      shift 2
      ;;
    -*) fail "unknown option $1; see try.sh --help" ;;
    *) [ -z "$image" ] || fail "two images: $image and $1"; image=$1; shift ;;
  esac
done
[ -n "$image" ] && [ -n "$runner" ] && [ -n "$contents" ] || { usage >&2; exit 2; }
[ -x "$runner" ] || fail "$runner is no program; copy leaderboard-runner out of the operator's image"
for needed in "leaderboard/leaderboard/leaderboard_evaluator.py" "leaderboard/$routes" scenario_runner CARLA/PythonAPI/carla; do
  [ -e "$contents/$needed" ] || fail "$contents/$needed is missing"
done

runner=$(realpath "$runner") contents=$(realpath "$contents")
mkdir -p "$out"
out=$(realpath "$out")
# The images run as users of their own, so all of this is writable for everybody, as in the Pod. What a run before has left of its
# messages would end this one at once.
rm -rf "$out/status"
mkdir -p "$out"/{agent,simulator} "$out"/status/{simulator-1,agent-1,logcopy}
chmod 0777 "$out"/{agent,simulator} "$out"/status/{simulator-1,agent-1,logcopy}
: >"$out/simulator-verdict.json"
: >"$out/agent-verdict.json"
chmod 0666 "$out"/*-verdict.json

case "$version" in
  V1)
    simulator_flags=(-carla-rpc-port=2000 -opengl -nosound)
    video_driver=offscreen
    traffic_manager=trafficManagerPort
    scenario_env=(--env "SCENARIOS=/workspace/leaderboard/$scenarios")
    scenario_flag=$'  \'--scenarios=$(SCENARIOS)\' \\\n' debug_flag=''
    ;;
  V2)
    simulator_flags=(-vulkan -carla-rpc-port=2000 -RenderOffScreen -nosound)
    video_driver=dummy
    traffic_manager=traffic-manager-port
    scenario_env=(--env DEBUG_CHECKPOINT_ENDPOINT=/tmp/agent/live_results.txt)
    scenario_flag='' debug_flag=$'  \'--debug-checkpoint=$(DEBUG_CHECKPOINT_ENDPOINT)\' \\\n'
    ;;
  *) fail "--version is V1 or V2" ;;
esac

python_path=/workspace/CARLA/PythonAPI/carla:/workspace/scenario_runner:/workspace/leaderboard
# The agent's command in the cluster. `$(NAME)` is expanded by the runner, before the shell sources anything of the image.
script=$(cat <<TEXT
[ -f ~/.bashrc ] && source ~/.bashrc
[ -f ~/agent_sources.sh ] && source ~/agent_sources.sh
: "\${TEAM_AGENT:?the image must set TEAM_AGENT to the path of its agent}"
case "\${PYTHONPATH-}:" in
  '$python_path:'*) ;;
  *) export PYTHONPATH='$python_path'"\${PYTHONPATH:+:\$PYTHONPATH}" ;;
esac
exec python3 -u '\$(LEADERBOARD_ROOT)/leaderboard/leaderboard_evaluator.py' \\
  '--port=\$(CARLA_PORT)' \\
  '--$traffic_manager=\$(CARLA_TM_PORT)' \\
  "--agent=\${TEAM_AGENT}" \\
  "--agent-config=\${TEAM_CONFIG-}" \\
  '--track=\$(CHALLENGE_TRACK_CODENAME)' \\
  '--routes=\$(ROUTES)' \\
  '--routes-subset=\$(ROUTES_SUBSET)' \\
${scenario_flag}  '--repetitions=\$(REPETITIONS)' \\
  '--resume=\$(RESUME)' \\
  '--checkpoint=\$(CHECKPOINT_ENDPOINT)' \\
  '--record=\$(RECORD_PATH)' \\
${debug_flag}  '--debug=\$(DEBUG_CHALLENGE)'
TEXT
)

# What both containers have. The verdict is written where the kubelet reads a container's last message.
common=(--cap-drop ALL --security-opt no-new-privileges --platform linux/amd64
  --entrypoint /leaderboard-tools/leaderboard-runner
  --volume "$runner:/leaderboard-tools/leaderboard-runner:ro"
  --volume "$out/status:/tmp/status:ro")
# In the cluster the variable says which GPU of the node it is; here Docker's own flag decides.
case "$gpus" in
  none) common+=(--env NVIDIA_VISIBLE_DEVICES=void) ;;
  *) common+=(--gpus "$gpus" --env NVIDIA_DRIVER_CAPABILITIES=all) ;;
esac

name=try-$$
stop() {
  # One after the other: the agent has the simulator's network, and podman removes no container on which another depends.
  docker rm --force "$name-agent" >"$out/docker.log" 2>&1 || true
  docker rm --force "$name-simulator" >>"$out/docker.log" 2>&1 || true
}
trap stop EXIT

# Without any network but its own loopback interface, which the agent shares.
docker run --detach --name "$name-simulator" --network none "${common[@]}" \
  --volume "$out/status/simulator-1:/tmp/status/simulator-1" \
  --volume "$out/simulator:/home/carla/CarlaUE4/Saved" \
  --volume "$out/simulator-verdict.json:/dev/termination-log" \
  --env CARLA_PORT=2000 --env "SDL_VIDEODRIVER=$video_driver" \
  "$simulator" simulator --pair=1 --status=/tmp/status --port=2000 --ready-seconds=3600 --peer-seconds=30 --flush-seconds=60 \
  --cancel-seconds=60 --log=/home/carla/CarlaUE4/Saved/console-1.log --log-limit=67108864 --unset=DISPLAY,XAUTHORITY -- \
  /bin/bash /home/carla/CarlaUE4.sh "${simulator_flags[@]}" >"$out/docker.log"

# The cluster starts a pair that crashed again, three times by default; here a server that ends is the end.
{
  docker wait "$name-simulator" >>"$out/docker.log" 2>&1 || true
  [ -e "$out/status/logcopy/logcopy.done" ] || docker stop "$name-agent" >>"$out/docker.log" 2>&1 || true
} &
watcher=$!

limits=()
[ -z "$memory" ] || limits=(--memory "$memory" --memory-swap "$memory")
code=0
docker run --name "$name-agent" --network "container:$name-simulator" "${common[@]}" ${limits[@]+"${limits[@]}"} \
  --volume "$out/status/agent-1:/tmp/status/agent-1" \
  --volume "$contents/leaderboard:/workspace/leaderboard:ro" \
  --volume "$contents/scenario_runner:/workspace/scenario_runner:ro" \
  --volume "$contents/CARLA:/workspace/CARLA:ro" \
  --volume "$out/agent:/tmp/agent" \
  --volume "$out/agent-verdict.json:/dev/termination-log" \
  --env CARLA_PORT=2000 --env CARLA_TM_PORT=2010 --env "CHALLENGE_TRACK_CODENAME=$track" \
  --env "ROUTES=/workspace/leaderboard/$routes" --env "ROUTES_SUBSET=$subset" --env "REPETITIONS=$repetitions" --env RESUME= \
  --env CHECKPOINT_ENDPOINT=/tmp/agent/agent_results.json --env RECORD_PATH=/home/carla/CarlaUE4/Saved --env DEBUG_CHALLENGE=0 \
  --env CARLA_ROOT=/workspace/CARLA --env SCENARIO_RUNNER_ROOT=/workspace/scenario_runner \
  --env LEADERBOARD_ROOT=/workspace/leaderboard "${scenario_env[@]}" \
  "$image" agent --pair=1 --status=/tmp/status --work=/tmp/agent --checkpoint=/tmp/agent/agent_results.json \
  --ready-seconds=3600 "--idle-seconds=$idle" --log-limit=2147483648 "--python-path=$python_path" -- \
  /bin/bash -c "$script"$'\n' || code=$?

# In the Pod logcopy writes it once all results are stored; the simulator waits for it.
: >"$out/status/logcopy/logcopy.done"
wait "$watcher"
printf '\nThe agent'\''s container ended with exit code %s. What its runner reports:\n%s\n' "$code" "$(cat "$out/agent-verdict.json")"
printf 'What the runner of the simulator reports:\n%s\n' "$(cat "$out/simulator-verdict.json")"
echo "Results: $out/agent/agent_results.json; log: $out/agent/leaderboard.log; the server's: $out/simulator/console-1.log"
exit "$code"
