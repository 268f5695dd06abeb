#!/usr/bin/env bash
# A sweep: a grid of runs (grid.py) -> one complete command per line -> an executor.
set -euo pipefail

usage() {
  cat <<'END'
Usage: ./benchmark.sh PRESET [grid options] [executor options] [-- script options]
       ./benchmark.sh status PRESET [grid options]

Presets
  demo       PPO on Hopper-v5, baseline and one noise, 100,000 steps, into runs/demo
  baseline   no noise: 3 algorithms, 5 environments, the paper's seeds
  best       the paper's best noise for each algorithm and environment
  paper      15 noises at 6 rates, 9,100 runs
  ablation   PPO with noise of several strengths (the paper's appendix)
  custom     whatever the grid options say
Every preset includes the baselines.

Grid options replace a preset's values
  --algos sac td3 ppo      --envs Hopper-v5 ...       --seeds 1-5 7
  --noises "RandomNormalNoisyReward(1.0)" "RandomEarlyTermination(50)+RandomMixupObservation(0.5)"
  --noise-rates 0.05 1.0   --total-timesteps 1000000  --runs-dir runs

Executor options
  --dry-run             print the commands, start nothing
  --executor local      (default) runs side by side on this machine
  --executor parallel   GNU parallel, on this machine or over ssh
  --executor slurm      job arrays; submits and returns
  --jobs N              runs at a time: on each machine (default: the number of its cores), or of
                        each job array (default: as many as the cluster has room for)
  --sshlogin LIST       machines in GNU parallel's notation: "hostA,hostB", "4/user@host", ":"
  --remote-dir DIR      where the project lies on machines that do not share this folder: run
                        folders are then sent and fetched with rsync
  --slurm-args "..."    options for sbatch, e.g. "--partition=cpu --time=24:00:00"
  --wait                slurm: wait for the jobs and report

Examples
  ./benchmark.sh demo
  ./benchmark.sh best --envs Hopper-v5 --seeds 1 --total-timesteps 200000 --runs-dir runs/short
  ./benchmark.sh custom --algos td3 --noises "RandomUniformScaleReward(0.5, 1.5)" --noise-rates 0.05
  ./benchmark.sh paper --executor parallel --sshlogin hostA,hostB
  ./benchmark.sh paper --executor slurm --slurm-args "--time=24:00:00 --mem-per-cpu=4G"
  ./benchmark.sh status paper
  ./benchmark.sh paper --dry-run | grep sac_ | head -n 1 | sh

The same command again starts what is not done and resumes what was interrupted. Ctrl-C stops
every run with a checkpoint. Logs: RUNS_DIR/logs. Paths count from the project's folder; the
interpreter is $PYTHON, else .venv/bin/python, else python. Exit status: 0 every run is done,
1 some are not, 2 bad arguments, 130 stopped by Ctrl-C. See docs/sweeps.md.
END
}

fail() { echo "error: $*" >&2 || true; exit 2; }

log_of() { echo "${1%/*}/logs/${1##*/}.log"; }

# FOLDER COMMAND: one run, its output framed by two lines that begin with "#"; returns its status.
# TERM and INT reach all processes of a run, from whoever sends them. USR1 reaches this shell
# only, and means: have the run write its checkpoint and end. It sets `asked`.
run_one() {
  asked=
  [ ! -e "$1/result.json" ] || return 0
  export OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PYTHONUNBUFFERED=1
  echo "# $(date '+%F %T') $HOSTNAME: $2"
  bash -c "exec $2" 2>&1 &
  local child=$! status=0
  trap : TERM INT
  trap '[ -n "$asked" ] || kill -TERM "$child" || true; asked=1' USR1
  while kill -0 "$child" 2>/dev/null; do wait "$child" && status=0 || status=$?; done
  echo "# $(date '+%F %T') $HOSTNAME: exit=$status"
  return "$status"
}

slurm_task() { # LINES OFFSET: one task of a job array, requeued if it was stopped by USR1
  local folder command status=0
  IFS=$'\t' read -r folder command < <(sed -n "$(($2 + SLURM_ARRAY_TASK_ID + 1))p" "$1")
  run_one "$folder" "$command" >>"$(log_of "$folder")" || status=$?
  if [ -n "$asked" ] && [ "$status" -eq 143 ]; then scontrol requeue "$SLURM_JOB_ID"; fi
  exit "$status"
}

cd "$(dirname "${BASH_SOURCE[0]}")"
case ${1:-} in # how the executors call this script: run-one and run-logged SWEEP FOLDER COMMAND
  run-one) # on a machine whose connection may break: the run must outlive its reader
    trap : TERM INT USR1
    run_one "$3" "$4" | { trap '' TERM INT USR1 && { cat || cat >/dev/null; }; } || exit 1
    exit ;;
  run-logged) # exit status 255 ends xargs, if the sweep that started it was killed
    driver=${2%-*} # the sweep's name without its time: HOST-PROCESS
    kill -0 "${driver##*-}" 2>/dev/null || exit 255
    run_one "$3" "$4" >>"$(log_of "$3")" || exit 1
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
    --dry-run) dry_run=1 && shift ;;
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

if [ -z "${PYTHON:-}" ]; then
  if [ -x .venv/bin/python ]; then PYTHON=.venv/bin/python; else PYTHON=python; fi
fi
export PYTHON
"$PYTHON" -c "import sys, importlib.util as u; sys.exit(not all(map(u.find_spec, sys.argv[1:])))" \
  gymnasium mujoco torch tyro tensorboard 2>/dev/null ||
  fail "'$PYTHON' lacks a package: set PYTHON, or install requirements.txt into .venv"
if [ $view = status ]; then exec "$PYTHON" grid.py status "${grid[@]}"; fi
lines=$("$PYTHON" grid.py list "${grid[@]}") || exit $?
todo=$(awk -F'\t' -v OFS='\t' '$2 == "todo" {print $1, $3}' <<<"$lines")
count=$(grep -c . <<<"$todo" || true)
echo "$(wc -l <<<"$lines") runs, $count to do" >&2
# Whatever becomes of the reader of a pipe ("| head"), nothing is started
if [ -n "$dry_run" ]; then cut -f3 <<<"$lines" || true; exit; fi

if [ "$executor" = parallel ]; then
  parallel --version 2>/dev/null | grep -q "GNU parallel" ||
    fail "--executor parallel needs GNU parallel (Debian: apt-get install parallel)"
elif [ "$executor" = slurm ]; then
  command -v sbatch >/dev/null || fail "--executor slurm needs sbatch, on a Slurm cluster"
else
  command -v xargs >/dev/null || fail "--executor local needs xargs (Debian: findutils)"
fi
if [ "$count" -eq 0 ]; then exec "$PYTHON" grid.py report "${grid[@]}"; fi

first=${lines%%$'\t'*}
sweep=$HOSTNAME-$$-$(date +%Y%m%d%H%M%S)
logs=${first%/*}/logs list=${first%/*}/logs/lines-$sweep.tsv
mkdir -p "$logs" || fail "--runs-dir: cannot write to ${first%/*}"
printf '%s\n' "$todo" >"$list"

run_local() { # nproc obeys OMP_NUM_THREADS, which is about the threads of one process
  cores=$(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc 2>/dev/null) ||
    cores=$(getconf _NPROCESSORS_ONLN)
  tr '\t\n' '\0\0' <"$list" |
    xargs -0 -n 2 -P "${jobs:-$cores}" ./benchmark.sh run-logged "$sweep"
}
stop_local() { kill -TERM -- "-$group"; } # xargs ends at once, the runs after their checkpoint

export PARALLEL_SSH=${PARALLEL_SSH:-ssh -o BatchMode=yes}
parallel_options=(--will-cite --workdir "${remote_dir:-$PWD}")
[ -z "$sshlogin" ] || parallel_options+=(--sshlogin "$sshlogin")
run_parallel() { # --termseq: where a connection is lost, the runs get TERM and are left in peace
  trap '' HUP
  local chatter='^parallel: (SIGHUP|Waiting for|\./benchmark)|will not be transferred'
  local options=(--jobs "${jobs:-100%}" --joblog "+$logs/joblog.tsv")
  options+=(--termseq "TERM,600000")
  [ -z "$remote_dir" ] || options+=(--transferfile '{1}' --return '{1}')
  parallel "${parallel_options[@]}" "${options[@]}" --line-buffer --tagstring '{1}' --colsep '\t' \
    ./benchmark.sh run-one "$sweep" '{1}' '{2}' :::: "$list" 2> >(grep -Ev "$chatter" >&2) |
    while IFS= read -r line; do
      printf '%s\n' "${line#*$'\t'}" >>"$(log_of "${line%%$'\t'*}")"
    done
}
stop_parallel() { # HUP: parallel starts no more runs, and waits for those that USR1 stops
  kill -HUP -- "-$group" 2>/dev/null
  local pattern="^bash ./benchmark.sh run-one $sweep"
  if [ -z "$sshlogin" ]; then
    pkill -USR1 -f "$pattern"
  else
    parallel "${parallel_options[@]}" --nonall pkill -USR1 -f "'$pattern'"
  fi
}

submit() { # the array's indices are line numbers, counted from the offset of its part
  local size offset n id
  size=$(scontrol show config | awk '$1 == "MaxArraySize" {print $3}')
  [ "${size:-0}" -gt 0 ] || fail "scontrol show config does not tell MaxArraySize"
  read -ra slurm_options <<<"$slurm_args"
  for ((offset = 0; offset < count; offset += size)); do
    n=$((count - offset < size ? count - offset : size))
    id=$(sbatch --parsable --array="0-$((n - 1))${jobs:+%$jobs}" --requeue --signal=B:USR1@180 \
      --ntasks=1 --cpus-per-task=1 --job-name=noisy-sweep \
      --open-mode=append --output="$logs/slurm-%A.out" \
      ${slurm_options[@]+"${slurm_options[@]}"} \
      --wrap "exec ./benchmark.sh slurm-task $(printf %q "$list") $offset") ||
      fail "sbatch refused runs $((offset + 1)) to $((offset + n)); submitted before: ${ids[*]}"
    ids+=("${id%%;*}")
  done
  echo "submitted; to stop: scancel ${ids[*]}" >&2
}
run_slurm() { # the arrays are over when squeue answers and does not name them
  local queue
  until queue=$(squeue --noheader --user="$(id -un)" --format=%F 2>/dev/null) &&
    ! grep -qxF "$(printf '%s\n' "${ids[@]}")" <<<"$queue"; do sleep 5; done
}
stop_slurm() { scancel "${ids[@]}"; }

if [ "$executor" = slurm ]; then
  ids=()
  trap '[ -z "${ids[*]}" ] || scancel "${ids[@]}"; exit 130' INT TERM HUP
  submit
  [ -n "$wait" ] || exit 0
else
  trap 'rm -f "$list"' EXIT
  [ -z "$sshlogin" ] || parallel "${parallel_options[@]}" --nonall --tag \
    "$PYTHON" -c "'import mujoco, torch, tyro, noisy_wrappers'" "&&" test -x benchmark.sh >&2 ||
    fail "a machine of --sshlogin cannot run the project in ${remote_dir:-$PWD} with $PYTHON"
fi

stopped=0
stop() { # EXIT_STATUS
  if [ "$executor" = parallel ] && [ "$stopped" -ne 0 ]; then kill -TERM -- "-$group"; fi
  "stop_$executor" || true
  [ "$stopped" -ne 0 ] || echo "stopping: every run writes a checkpoint first" >&2 || true
  stopped=$1
}

# The executor has a process group of its own, so that one signal to it reaches every run once.
set -m
"run_$executor" &
group=$! watch=''
set +m
trap '' PIPE # whoever reads what this prints may leave first
trap 'stop 130' INT
trap 'stop 143' TERM HUP
[ ! -t 2 ] || { "$PYTHON" grid.py watch "${grid[@]}" & watch=$!; }
while kill -0 -- "-$group" 2>/dev/null; do
  sleep 1 & wait $! || true # a trap interrupts wait, not sleep
  [ "$stopped" -eq 0 ] || [ "$executor" != parallel ] || stop_parallel || true # for late starters
done
[ -z "$watch" ] || { kill "$watch" && echo >&2; }
if [ "$stopped" -ne 0 ]; then
  "$PYTHON" grid.py stopped "${grid[@]}"
  echo "stopped; the same command goes on from here"
  exit "$stopped"
fi
"$PYTHON" grid.py report "${grid[@]}"
