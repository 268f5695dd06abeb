# shellcheck shell=bash
# How benchmark.sh, which sources this file, has commands executed: `run_one` is a run, and for each
# executor NAME there are run_NAME, which returns when all commands of the file $list are over, and
# stop_NAME, which has them write their checkpoints and end. Slurm's run_slurm only waits: `submit`
# submits.

# ------------------------------------------------------------------------------------------ one run

log_of() { echo "${1%/*}/logs/${1##*/}.log"; }

quoted() { # TEXT: as one word of any sh, which does not know all that printf %q writes
  printf "'%s'" "${1//\'/\'\\\'\'}"
}

# SWEEP FOLDER: a script that refuses its arguments refuses them with every seed. The first run
# leaves this file, and the sweep starts no run of another seed (on this machine, if machines share
# no folder). Other environments and noises are tried: it may be one of these that is refused.
refusal_of() {
  local name=${2##*/} # RATE_sSEED_NOISE__ENVIRONMENT__..., or baseline_sSEED__...
  echo "${2%/*}/logs/.refused-$1-${name%%_s*}_${name#*_s*_}"
}

# SWEEP FOLDER COMMAND [BEGUN]: one run, its output framed by two lines that begin with "#"; returns
# its status. The output goes into the log if `logged` is set. BEGUN is "new" where the machine of
# benchmark.sh has no such folder: a finished run in it on this one may be old.
# TERM and INT reach all processes of a run, from whoever sends them. USR1 reaches this shell
# only, and means: have the run write its checkpoint and end. It sets `asked`.
# The log is locked while the run lives, even if only the run itself survives: whoever else wants
# to start the same run waits for it, and goes on with it if it was stopped.
run_one() {
  local refusal
  refusal=$(refusal_of "$1" "$2")
  shift
  asked=
  [ ! -e "$refusal" ] || return 2
  mkdir -p "${1%/*}/logs" # on a machine that does not share the folder, too
  exec 9>>"$(log_of "$1")" || return 99 # this machine cannot write: another one may
  if ! flock --nonblock 9; then
    echo "$1 is running already: waiting for it (another sweep, or a process that an ended run left)" >&2
    flock 9 & # in the background, so that a signal ends the waiting
    local waiting=$!
    trap 'asked=1; kill "$waiting" || true' USR1
    wait "$waiting" || return 143
    trap - USR1
  elif [ "${3:-}" = new ] && [ -e "$1/result.json" ]; then
    mv -- "$1" "${1%/*}/.${1##*/}.old-$(date +%s)" # hidden, and not deleted: it may have been lost
  fi
  [ ! -e "$1/result.json" ] || return 0
  [ -z "${logged:-}" ] || exec >&9
  export OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 PYTHONUNBUFFERED=1
  echo "# $(date '+%F %T') $HOSTNAME: $2" || return 99 # the disk is full, as bash says
  bash -c "exec $2" 2>&1 &
  local child=$! status=0
  trap : TERM INT
  trap '[ -n "$asked" ] || kill -TERM "$child" || true; asked=1' USR1
  # A signal interrupts wait, so ask again. bash would report a killed run with a line of this file.
  while kill -0 "$child"; do wait "$child" || true; done 2>/dev/null
  wait "$child" || status=$?
  # analysis/logs.py reads the last line. What the run printed may have ended within one, as the
  # bar of a killed program does.
  printf '\n# %s %s: exit=%s\n' "$(date '+%F %T')" "$HOSTNAME" "$status" || true
  [ "$status" -ne 2 ] || touch "$refusal" 2>/dev/null || true
  return "$status"
}

# LINES OFFSET: one task of a job array, requeued if it was stopped by USR1. The SLURM_JOB_ID of the
# array's last task is the id of the whole array, which would be requeued by it.
slurm_task() {
  local folder command sweep status=0 logged=1
  IFS=$'\t' read -r folder command < <(sed -n "$(($2 + SLURM_ARRAY_TASK_ID + 1))p" "$1")
  sweep=${1##*/lines-} # its id stands in the name of the list
  run_one "${sweep%.tsv}" "$folder" "$command" || status=$?
  # Without a checkpoint it would begin anew, time after time
  if [ -n "$asked" ] && [ "$status" -eq 143 ] && [ -e "$folder/checkpoint.pt" ]; then
    # SLURM_CLUSTERS came along from where it was submitted: the task is one of this cluster
    env -u SLURM_CLUSTERS scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
  fi
  exit "$status"
}

# -------------------------------------------------------------------------------------------- local

run_local() { # nproc obeys OMP_NUM_THREADS, which is about the threads of one process
  local cores folder command logged=1
  cores=$(env -u OMP_NUM_THREADS -u OMP_THREAD_LIMIT nproc)
  while IFS=$'\t' read -r folder command; do
    while [ "$(jobs -pr | wc -l)" -ge "${jobs:-$cores}" ]; do wait -n || true; done
    run_one "$sweep" "$folder" "$command" &
  done <"$list"
  wait
}
stop_local() { kill -TERM -- "-$group"; } # run_local ends at once, the runs after their checkpoint

# ----------------------------------------------------------------------------------------- parallel

run_parallel() { # --termseq: where a connection is lost, the runs get TERM and are left in peace
  trap '' HUP
  local chatter='^parallel: (SIGHUP|Waiting for|\./benchmark)|will not be transferred'
  local options=(--jobs "${jobs:-100%}" --joblog "+$logs/joblog.tsv" --termseq "TERM,600000")
  # run-one fails where the connection does: then another machine gets the run
  local commas=${sshlogin//[^,]/}
  options+=(--retries "$((${#commas} + 3))" --line-buffer --tagstring '{1}' --colsep '\t' --trim n)
  local begun='' folder
  if [ -n "$remote_dir" ]; then
    options+=(--transferfile '{1}' --return '{1}')
    # shellcheck disable=SC2016  # of Perl, by GNU parallel
    begun='{=1 $_ = -e $_ ? "begun" : "new" =}' # here, when the run starts
  fi
  parallel "${parallel_options[@]}" "${options[@]}" \
    ./benchmark.sh run-one "$sweep" '{1}' '{2}' "$begun" :::: "$list" 2> >(grep -Ev "$chatter" >&2) |
    while IFS= read -r line; do
      printf '%s\n' "${line#*$'\t'}" 2>/dev/null >>"$(log_of "${line%%$'\t'*}")" || true
    done || true # runs that were given up
  [ -n "$remote_dir" ] || return 0
  while IFS=$'\t' read -r folder _; do # what was finished elsewhere may have a checkpoint here
    [ ! -e "$folder/result.json" ] || rm -f "$folder/checkpoint.pt"
  done <"$list"
}
stop_parallel() { # HUP: parallel starts no more runs, and waits for those that USR1 stops
  local seconds
  for ((seconds = 0; seconds < 3600; seconds++)); do # again for late starters
    kill -HUP -- "-$group" 2>/dev/null || break
    parallel "${parallel_options[@]}" --nonall \
      pkill -USR1 -f "'^bash ./benchmark.sh run-one $sweep'" || true
    sleep 1
  done
}

# -------------------------------------------------------------------------------------------- slurm

array_limit() { # sets array_size, before anything is written
  unset "${!SQUEUE_@}" "${!SCANCEL_@}" # a user's own, such as SQUEUE_STATES, would hide jobs
  array_size=$(scontrol show config 2>/dev/null | awk '$1 == "MaxArraySize" {print $3; exit}') ||
    true
  [ "${array_size:-0}" -gt 0 ] || [ "$stopped" -ne 0 ] ||
    fail "Slurm does not answer: scontrol show config has no MaxArraySize"
}

submit() { # the array's indices are line numbers, counted from the offset of its part
  local count offset n said id
  count=$(wc -l <"$list")
  for ((offset = 0; offset < count && stopped == 0; offset += array_size)); do
    n=$((count - offset < array_size ? count - offset : array_size))
    said=$(sbatch --parsable --array="0-$((n - 1))${jobs:+%$jobs}" --requeue --signal=B:USR1@180 \
      --ntasks=1 --cpus-per-task=1 --job-name=noisy-sweep \
      --open-mode=append --output="${logs//%/%%}/slurm-%A.out" \
      ${slurm_options[@]+"${slurm_options[@]}"} \
      --wrap "exec $(quoted "$PWD/benchmark.sh") slurm-task $(quoted "$list") $offset") || said=''
    # ID or ID;CLUSTER; a site's sbatch may print more lines
    if ! id=$(printf '%s\n' "$said" | grep -xE '[0-9]+(;[A-Za-z0-9_.-]+)?'); then
      [ "$stopped" -eq 0 ] || break # Ctrl-C ends sbatch, too
      fail "sbatch refused runs $((offset + 1)) to $((offset + n)); submitted before: ${ids[*]:-none};" \
        "run the same command again when they are over"
    fi
    trap - EXIT # of benchmark.sh, which removes the list: the tasks read it later
    ids+=("$id")
  done
  if [ "$stopped" -ne 0 ]; then
    stop_slurm
  else
    echo "submitted; to stop: $(cancels | paste -sd';' | sed 's/;/; /g')" >&2
  fi
}

cluster_of() { case $1 in *";"*) echo "--clusters=${1#*;}" ;; esac; } # ID or ID;CLUSTER
cancels() { # the commands that cancel all arrays
  local id
  for id in ${ids[@]+"${ids[@]}"}; do
    echo "scancel $(cluster_of "$id") ${id%;*}" | tr -s ' '
  done
}
run_slurm() { # an array is over when squeue answers and does not name it
  local id queue
  for id in "${ids[@]}"; do
    # shellcheck disable=SC2046  # no cluster, no word
    until queue=$(squeue $(cluster_of "$id") --noheader --user="$(id -un)" --format=%F 2>/dev/null) &&
      ! printf '%s\n' "$queue" | grep -qx "${id%;*}"; do sleep 5; done
  done
}
stop_slurm() {
  local command
  while IFS= read -r command <&3; do $command || true; done 3< <(cancels)
}
