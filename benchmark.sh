#!/usr/bin/env bash
# A sweep: a grid of runs (python -m sweep list) -> one complete command per line -> an executor
# (sweep/executors.sh).
set -euo pipefail

usage() {
  cat <<'END'
Usage: ./benchmark.sh PRESET [grid options] [executor options] [-- script options]
       ./benchmark.sh choose --algos ... --envs ... [options as above]
       ./benchmark.sh status [PRESET [grid options]] [--runs-dir ...]

Presets
  choose     finds a noise that helps: for each algorithm and environment, tries the noises, gives
             the better half of them more seeds in each round, compares the winner with no noise on
             fresh seeds, and prints a verdict; the runs are stored in runs/choose
  demo       PPO on InvertedPendulum-v5, with one noise, in a minute or two, into runs/demo
  baseline   no noise: 3 algorithms, 5 environments, the paper's seeds
  best       the paper's best noise for each algorithm and environment
  paper      15 noises at 6 rates, 9,100 runs
  ablation   PPO with noise of several strengths (the paper's appendix)
  custom     the noises that the grid options name; the rest is as in baseline
Every preset includes the baselines.

Grid options replace a preset's values
  --algos sac td3 ppo
             an algorithm of your own, redq, is the file redq_continuous_noisy.py in the project's or
             in the current folder
  --envs Hopper-v5 my_envs:MyEnv-v0
             your own environment, from my_envs.py in the current folder
  --seeds 1-5 7
  --baseline-seeds 1-13
             seeds without noise; default: those of --seeds, in custom more (docs/sweeps.md)
  --noises "RandomNormalNoisyReward(1.0)" "RandomEarlyTermination(50)+RandomMixupObservation(0.5)"
             noises joined by + are combined
  --noise-rates 0.05 1.0 1.0:0.0
             each noise is run at each rate; 1.0:0.0 falls linearly during training
  --noises "RandomNormalNoisyReward(1.0)@0.1+RandomEarlyTermination(50)@0.2"
             a rate for each noise; --noise-rates does not apply here
  --total-timesteps 1e6
  --runs-dir runs
             folder of the runs, relative to the current folder (choose: runs/choose, demo:
             runs/demo)

Options of choose
  --noises paper           the paper's 15 noises at 6 rates, 318 runs at most. The default is 11 noises
                           at rates 0.05 and 1.0, 110 runs at most (docs/sweeps.md)
  --exclude "NOISE@RATE"   noises to leave out, for example because they always fail
  --budget N               about how many runs the search may take (default: 3 for each noise and
                           rate, at least 1); even with the least it takes about two for each
  --confirm N              fresh seeds for the final comparison, at most (default: 25)
  --looks N                how often the comparison is looked at, and may end (default: after every
                           five seeds, at most five times; 1: at the end)
  --metric success_rate    choose by the rate of success (default: return), where the info of an
                           episode's last step has is_success or success

Executor options
  --dry-run             print the commands of the remaining runs, and what they cost; start nothing
  --executor local      (default) runs side by side on this machine
  --executor parallel   GNU parallel, on this machine or over ssh
  --executor slurm      job arrays; submits and returns
  --jobs N              runs at a time: on each machine (default: the number of its cores), or of
                        each job array (default: as many as the cluster has room for)
  --sshlogin LIST       machines in GNU parallel's notation: "hostA,hostB", "4/user@host", ":"
  --remote-dir DIR      the project's folder on machines that do not share this one: run folders
                        are then copied with rsync
  --slurm-args "..."    options for sbatch, e.g. "--partition=cpu --time=24:00:00"
  --wait                slurm: wait for the jobs and report (choose always waits)

Put options of the training scripts, such as --eval-episodes 20, at the end, after "--"; also
--exp-name, which keeps runs with other options or of another version apart.

Examples
  ./benchmark.sh choose --algos ppo --envs Pusher-v5 --noise-rates 1.0
  ./benchmark.sh best --envs Hopper-v5 --seeds 1 --total-timesteps 2e5 --runs-dir runs/short
  ./benchmark.sh custom --algos td3 --noises "RandomUniformScaleReward(0.5, 1.5)" --noise-rates 0.05
  ./benchmark.sh paper --executor parallel --sshlogin hostA,hostB
  ./benchmark.sh paper --executor slurm --slurm-args "--time=24:00:00 --mem-per-cpu=4G"
  ./benchmark.sh status --runs-dir runs/short
  ./benchmark.sh paper --dry-run | grep sac_ | head -n 1 | sh

Run the same command again to resume: finished runs are skipped. Ctrl-C saves a checkpoint of every
run and exits. `status` without a preset counts all runs in RUNS_DIR. Logs are in logs/ beside the
runs. The interpreter is $PYTHON, else .venv/bin/python, else python. Exit status: 0 all runs are
done (slurm without --wait: submitted), 1 some are not, 2 bad arguments, 130 or 143 stopped. See
docs/sweeps.md.
END
}

fail() { echo "error: $*" >&2 || true; exit 2; }
pass_on() { # what a run prints; where its reader has left, the run goes on
  trap '' TERM INT USR1
  cat || cat >/dev/null
}

caller=$(pwd -P)
cd "$(dirname -- "$(readlink -f -- "${BASH_SOURCE[0]}")")" # it may be called through a link
. sweep/executors.sh
case ${1:-} in # how the executors call this script: run-one SWEEP FOLDER COMMAND
  run-one) # on a machine whose connection may break: the run must outlive its reader
    trap : TERM INT USR1
    # A run that fails says so in its log: to GNU parallel, only a machine can fail
    run_one "$2" "$3" "$4" "${5:-}" | pass_on || [ $? -ne 99 ]
    exit ;;
  slurm-task) slurm_task "$2" "$3" ;;
  "" | -h | --help) usage || true; exit ;;
esac

view=list executor=local jobs='' sshlogin='' remote_dir='' slurm_args='' wait='' dry_run='' grid=()
[ "$1" != status ] || { view=status && shift; }
while [ $# -gt 0 ]; do
  case $1 in
    --executor=* | --jobs=* | --sshlogin=* | --remote-dir=* | --slurm-args=*)
      set -- "${1%%=*}" "${1#*=}" "${@:2}" ;;
    --executor | --jobs | --sshlogin | --remote-dir | --slurm-args)
      [ $# -gt 1 ] || fail "$1 needs a value"
      option=${1#--}
      printf -v "${option//-/_}" %s "$2"
      shift 2 ;;
    --dry-run) dry_run=dry-run && shift ;;
    --wait) wait=1 && shift ;;
    -h | --help) usage || true; exit ;;
    --) grid+=("$@") && break ;;
    *) grid+=("$1") && shift ;;
  esac
done
[[ $executor =~ ^(local|parallel|slurm)$ ]] ||
  fail "unknown executor '$executor'; choose local, parallel or slurm"
[[ $jobs =~ ^([1-9][0-9]*)?$ ]] || fail "--jobs must be a number greater than 0, not '$jobs'"
[ "$executor" = parallel ] || [ -z "$sshlogin$remote_dir" ] ||
  fail "--sshlogin and --remote-dir belong to --executor parallel"
[ "$executor" = slurm ] || [ -z "$slurm_args$wait" ] ||
  fail "--slurm-args and --wait belong to --executor slurm"
[ "${grid[0]:-}" != choose ] || wait=1 # for each batch of runs: their returns decide on the next

# Relative paths count from the folder of the command
case ${PYTHON:-} in '' | /*) ;; */*) PYTHON=$caller/$PYTHON ;; esac
[ -n "${PYTHON:-}" ] || [ ! -x .venv/bin/python ] || PYTHON=.venv/bin/python
export PYTHON=${PYTHON:-python}
# A module of the user's, as in my_envs:MyEnv-v0, lies there, too. Without a colon there is none, and
# the folder stays off the path: a file in it could have the name of one of Python's own modules.
# (A status of a choice reads in choice.json which environments it has.)
if [ "$caller" != "$PWD" ] &&
  [[ ($view = status && ${grid[0]:-} = choose) || "${grid[*]}" = *:[A-Za-z_]* ]]; then
  export PYTHONPATH=${PYTHONPATH:+$PYTHONPATH:}$caller
fi
lacking=$("$PYTHON" -c "import sys, importlib.util as u
print(*[name for name in sys.argv[1:] if not u.find_spec(name)], sep=', ')" \
  gymnasium mujoco torch tyro tensorboard 2>/dev/null) ||
  fail "'$PYTHON' is not a Python 3: set PYTHON, or install requirements.txt into .venv"
[ -z "$lacking" ] ||
  fail "'$PYTHON' lacks $lacking: set PYTHON, or install requirements.txt into .venv"

show() {
  OMP_NUM_THREADS=1 "$PYTHON" -X faulthandler -m sweep "$1" "$caller" ${grid[@]+"${grid[@]}"}
}
[ $view != status ] || { show status; exit; }

# sets `todo`: the runs to do, but for those that were tried, a line each: folder, command
list_todo() {
  local status=0
  todo=$(show "${dry_run:-list}") || status=$?
  [ "$status" -eq 0 ] || exit "$status"
  todo=$(printf '%s\n' "$todo" | grep -vxFf <(printf '%s\n' "$tried")) || [ $? -eq 1 ] # no line is left
}
tried=''
list_todo
first=${todo%%$'\t'*}
[ -z "$remote_dir" ] || [ "${first#/}" = "$first" ] ||
  fail "--remote-dir needs a relative --runs-dir in the project's folder, not ${first%/*}"
# Whatever becomes of the reader of a pipe ("| head"), nothing is started
if [ -n "$dry_run" ]; then printf %s "$todo" | cut -f2 || true; exit; fi
[ -n "$todo" ] || { show report; exit; }

case $executor in
  parallel)
    parallel --plain --version 2>/dev/null | grep -q "GNU parallel" ||
      fail "--executor parallel needs GNU parallel (Debian: apt-get install parallel)"
    export PARALLEL_SSH=${PARALLEL_SSH:-ssh -o BatchMode=yes}
    # --plain: nothing of the user's settings, such as --halt, changes what a sweep does
    parallel_options=(--plain --will-cite --workdir "${remote_dir:-$PWD}" --sshlogin "${sshlogin:-:}")
    [ -z "$sshlogin" ] || parallel "${parallel_options[@]}" --nonall --tag \
      "$(quoted "$PYTHON")" -c "'import mujoco, torch, tyro, noisy_wrappers'" "&&" test -x benchmark.sh >&2 ||
      fail "a machine of --sshlogin cannot run the project in ${remote_dir:-$PWD} with $PYTHON" ;;
  slurm)
    command -v sbatch >/dev/null || fail "--executor slurm needs sbatch, on a Slurm cluster"
    words=$(printf '%s\n' "$slurm_args" | xargs -rn1 printf '%s\n' 2>/dev/null) ||
      fail "--slurm-args has a quote that does not end: $slurm_args"
    [ -z "$words" ] || mapfile -t slurm_options < <(printf '%s\n' "$words") ;;
esac

sweep=$HOSTNAME-$$-$(date +%Y%m%d%H%M%S)
logs=${first%/*}/logs list=${first%/*}/logs/lines-$sweep.tsv
folders=() # of the logs
trap 'rm -f "$list"; forget_refusals' EXIT
forget_refusals() { # of scripts that were refused: the same command may try them again
  local folder
  for folder in ${folders[@]+"${folders[@]}"}; do rm -f "$folder/.refused-$sweep-"*; done
}

# Were this command killed, the executor would start run after run: the guard stops it then
guard() { # a killed command may stay as a zombie: it is dead when the guard has another parent
  local me=$BASHPID
  while [ "$(cut -d ' ' -f 4 "/proc/$me/stat")" -eq $$ ]; do sleep 1; done
  "stop_$executor"
}

stopped=0 group='' ids=()
stop() { # EXIT_STATUS
  if [ "$stopped" -eq 0 ]; then
    stopped=$1
    echo "stopping: every run saves a checkpoint first" >&2 || true
    [ -z "$group${ids[*]}" ] || "stop_$executor" &
  elif [ "$executor" = slurm ]; then
    stop_slurm || true
  elif [ -n "$group" ] && [ "$executor" = local ]; then
    kill -KILL -- "-$group" || true # TERM would let each run end its episode
  elif [ -n "$group" ]; then
    kill -TERM -- "-$group" || true
  fi
}

# The executor and its guard have process groups of their own, so that one signal to the executor's
# reaches every run once.
run_todo() {
  local reason guard watch
  [ "$executor" != slurm ] || array_limit
  mapfile -t folders < <(printf '%s\n' "$todo" | cut -f1 | sed 's,/[^/]*$,/logs,' | sort -u)
  reason=$( (mkdir -p "${folders[@]}" && printf '%s\n' "$todo" >"$list") 2>&1) ||
    fail "--runs-dir: cannot write to $logs: ${reason##*: }"
  flock "$list" true ||
    fail "--runs-dir: cannot lock files in $logs (by flock), so two processes could write into one run"
  [ "${grid[0]}" != choose ] || show begin
  if [ "$executor" = slurm ]; then
    submit
    [ -n "$wait" ] || exit "$stopped"
    [ "${#ids[@]}" -gt 0 ] || return 0 # stopped before the first array
  fi
  trap - PIPE
  set -m
  "run_$executor" &
  group=$!
  guard &
  guard=$!
  set +m
  [ "$stopped" -eq 0 ] || "stop_$executor" &
  trap '' PIPE # whoever reads what this prints may leave first
  WATCHED=$$ "$PYTHON" -m sweep watch "$caller" "${grid[@]}" & watch=$!
  # After a signal, runs outlive the executor. Otherwise, what does is some environment's.
  while kill -0 "$group" 2>/dev/null ||
    { [ "$stopped" -ne 0 ] && kill -0 -- "-$group" 2>/dev/null; }; do
    sleep 1 & wait $! || true # a trap interrupts wait, not sleep
  done
  kill -- "-$guard" 2>/dev/null || true
  kill "$watch" 2>/dev/null && { [ ! -t 2 ] || echo >&2; } || true
  group='' ids=()
  forget_refusals
  tried+=$'\n'$todo
  export SWEEP_WAITED=1 # results of other machines may be seen a little later
}

trap 'stop 130' INT
trap 'stop 143' TERM HUP
while [ -n "$todo" ]; do
  run_todo
  if [ "$stopped" -ne 0 ]; then
    show stopped
    echo "stopped; run the same command again to resume"
    exit "$stopped"
  fi
  [ "${grid[0]}" = choose ] || break
  list_todo
done
show report
