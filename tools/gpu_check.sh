#!/usr/bin/env bash
# Whether --cuda is right, and how fast it is beside this machine's CPU. Prints Markdown for
# docs/performance.md; ends with 1 if a check has failed. Meant to take less than ten minutes on a
# machine with a CUDA GPU and 16 cores.
#
#     PYTHON=.venv/bin/python tools/gpu_check.sh | tee gpu_check.md
#     PYTHON=.venv/bin/python tools/gpu_check.sh --rehearse    # everything on the CPU, in few steps
#
# Runs and logs are left in runs/gpu_check.
set -uo pipefail
cd "$(dirname "$0")/.." || exit

python=${PYTHON:-python3}
folder=${RUNS_DIR:-runs/gpu_check}
read -ra algorithms <<<"${ALGORITHMS:-sac td3 ppo}"
read -ra environments <<<"${ENVIRONMENTS:-HalfCheetah-v5 Humanoid-v5}"
export DEVICE=cuda JOBS="1 2 4 8" SECONDS_OF_BLOCK=5
export OMP_NUM_THREADS=1 TORCHINDUCTOR_COMPILE_THREADS=1 PYTHONPATH=tools
steps=5000 on_device=(--cuda) failed=0
if [[ ${1:-} == --rehearse ]]; then
    export DEVICE=cpu JOBS="1 2" SECONDS_OF_BLOCK=0.1
    steps=${STEPS:-1000} on_device=() # not fewer than 320
fi
rm -rf "$folder" && mkdir -p "$folder" || exit

"$python" - <<'END' || exit
import os, torch

name = torch.cuda.get_device_name() if os.environ["DEVICE"] == "cuda" else "rehearsed on the CPU"
print(f"{name}, {os.cpu_count()} cores, PyTorch {torch.__version__}", flush=True)
END

echo -e "\n## Losses and gradients, compared with those of the CPU in float32\n"
"$python" - "${algorithms[@]}" <<'END' || failed=1
import importlib, os, sys
from types import SimpleNamespace

import torch
from gymnasium.spaces import Box

env = SimpleNamespace(observation_space=Box(-9, 9, (17,)), action_space=Box(-1, 1, (6,)))


def cases(algorithm, script, device):
    """Return the losses of a script: (loss, the network that it learns, its other inputs)."""
    torch.manual_seed(21)  # no ReLU's input is so close to 0 that rounding decides its gradient
    batch = [torch.randn(256, 17), torch.rand(256, 6) * 2 - 1, torch.randn(256)]
    batch += [torch.randn(256, 17), (torch.rand(256) < 0.1).float()]
    eps, values = torch.randn(256, 6).to(device), torch.randn(3, 256).to(device)
    batch = [tensor.to(device) for tensor in batch]
    if algorithm == "ppo":
        agent = script.Agent(env).to(device)
        log_probs = agent(*batch[:2])[0] + 0.1 * batch[2]
        return [(script.ppo_loss, agent, [*batch[:2], log_probs, *values], script.Args())]
    actor, critic = script.Actor(env).to(device), script.Critic(env).to(device)
    target = script.Critic(env).to(device)
    if algorithm == "td3":
        critics = script.critic_loss, critic, target, actor, batch, 0.1 * eps, 0.99
        return [critics, (script.actor_loss, actor, critic, batch[0])]
    temperature = torch.nn.ParameterDict({"log_alpha": torch.tensor(-1.0)}).to(device)
    return [
        (script.critic_loss, critic, target, actor, temperature, batch, eps, 0.99),
        (script.actor_loss, actor, critic, temperature, batch[0], eps),
        (script.temperature_loss, temperature, actor, batch[0], eps, -6.0),
    ]


@torch.no_grad()
def learn(algorithm, device, compiled):
    """Return {name: tensor} of what the losses give, and of the gradients that are applied."""
    script, found = importlib.import_module(f"{algorithm}_continuous_noisy"), {}
    script.say = sys.exit  # which says that something was not compiled
    args = script.Args(compile=compiled, matmul_precision="highest")
    for loss, network, *inputs in cases(algorithm, script, device):
        optimizer = torch.optim.Adam(network.parameters(), lr=0.0, fused=True)
        curves = script.updater(loss, network, optimizer, args)(*inputs)
        gradients = {name: p.grad for name, p in network.named_parameters()}
        for name, value in (curves | gradients).items():
            found[f"{loss.__name__}: {name}"] = value.cpu()
    return found


print("| script | compiled | tensors | largest difference | of |\n|---|---|---|---|---|")
largest = 0.0
for algorithm in sys.argv[1:]:
    expected = learn(algorithm, "cpu", compiled=False)
    for compiled in (False, True):
        got, differences = learn(algorithm, os.environ["DEVICE"], compiled), {}
        for name, value in expected.items():  # beside the largest entry, or 0.001
            difference = (got[name] - value).abs().max() / value.abs().max().clamp(min=1e-3)
            differences[name] = difference.item() if difference.isfinite() else float("inf")
        name = max(differences, key=differences.get)
        largest = max(largest, differences[name])
        cells = algorithm, "yes" if compiled else "no", len(got), f"{differences[name]:.1e}", name
        print("|", " | ".join(map(str, cells)), "|", flush=True)
if largest > 1e-4:
    sys.exit("FAILED: they differ by more than 1e-4")
END

# train NAME ALGORITHM ENVIRONMENT...: a whole run in a folder of its own, its output in a log
# shellcheck disable=SC2329  # begin calls it, and resume
train() {
    local name=$1 algorithm=$2 arguments
    arguments=(--env-id "$3" --total-timesteps "$steps" --max-episode-steps $((steps / 5)))
    arguments+=(--eval-frequency $((steps / 5)) --eval-episodes 2 --runs-dir "$folder/$name")
    if [[ $algorithm == ppo ]]; then
        arguments+=(--num-steps $((steps / 5 - steps / 5 % 32)))
    else
        arguments+=(--learning-starts $((steps / 5)))
    fi
    shift 3
    arguments+=("${on_device[@]}" "$@")
    timeout 300 "$python" - "$algorithm" "${stop_after:-0}" "${arguments[@]}" \
        >>"$folder/$name.log" 2>&1 <<'END'
import importlib, itertools, sys

import tyro

script, episodes = importlib.import_module(f"{sys.argv[1]}_continuous_noisy"), itertools.count(1)
args = tyro.cli(script.Args, args=sys.argv[3:])
finished = script.train(args, stop=lambda: next(episodes) == int(sys.argv[2]))
assert finished == (sys.argv[2] == "0")
END
}

# resume NAME ALGORITHM ENVIRONMENT...: the same, stopped after the third episode
# shellcheck disable=SC2329
resume() {
    stop_after=3 train "$@" && train "$@"
}

# row NAME: the test return of a run
row() {
    local result
    result=$(sed -n 's/.*"final_return_mean": \(.*\),/\1/p' "$folder/$1"/*/result.json)
    [[ -n $result ]] && result=$(printf %.2f "$result")
    if grep -q "not compiled" "$folder/$1.log"; then
        result="FAILED: not compiled"
    elif [[ -z $result ]]; then
        result="FAILED: see $folder/$1.log"
    elif [[ $1 == *resumed ]]; then
        cmp -s "$folder/$1"/*/eval.csv "$folder/${1%resumed}compiled"/*/eval.csv &&
            result+=", eval.csv as without a stop" || result="FAILED: another eval.csv"
    fi
    [[ $result == FAILED* ]] && failed=1
    echo "| $1 | $result |"
}

echo -e "\n## Runs of $steps steps\n\n| run | test return |\n|---|---|"
names=()
begin() { # COMMAND NAME...: in the background, as many at a time as there are cores
    while (($(jobs -rp | wc -l) >= $(nproc))); do wait -n; done
    names+=("$2")
    "$@" &
}
for algorithm in "${algorithms[@]}"; do
    for environment in "${environments[@]}"; do
        name=$algorithm-$environment
        begin train "$name-compiled" "$algorithm" "$environment"
        begin train "$name-not_compiled" "$algorithm" "$environment" --no-compile
    done
    name=$algorithm-${environments[0]}
    begin resume "$name-resumed" "$algorithm" "${environments[0]}"
done
wait
for name in "${names[@]}"; do row "$name"; done

echo -e "\n## Steps per second of all runs together\n"
"$python" - "${algorithms[*]}" "${environments[@]}" <<'END' || failed=1
import contextlib, os, sys
from types import SimpleNamespace

import bench
import torch

algorithms, environments = sys.argv[1].split(), sys.argv[2:]
jobs, cuda = [int(number) for number in os.environ["JOBS"].split()], ["--cuda"]
cores = sorted(os.sched_getaffinity(0), reverse=True)
device = "GPU"
if os.environ["DEVICE"] == "cpu":
    device, cuda, bench.LEARNING_STARTS = "CPU in place of a GPU", [], 100
processor = torch.cpu.get_capabilities()
names = ("avx512_bf16", "amx_bf16", "bf16", "sve_bf16")
has_bf16 = device == "GPU" or any(processor.get(name) for name in names)  # as the scripts ask
options = SimpleNamespace(seconds=float(os.environ["SECONDS_OF_BLOCK"]), clock="wall")
runs = [f"{number} at a time" if number > 1 else "1 run" for number in jobs]
print(f"| | {' | '.join(runs)} |\n|---|{'---|' * len(jobs)}", flush=True)
for algorithm in algorithms:
    # on a GPU "medium" is computed as "highest", which is the default there
    precisions = ["bf16"] if has_bf16 and algorithm != "ppo" else []
    precisions += ["highest", "medium"] if device != "GPU" else []
    cases = {}  # the flags and the largest number of runs
    for environment in environments:
        most = max(jobs) if environment == environments[0] else 1
        cases[f"{environment}, CPU"] = environment, [], most
        cases[f"{environment}, {device}"] = environment, cuda, most
    for flags in (["--no-compile"], *(["--matmul-precision", name] for name in precisions)):
        cases[f"{environments[0]}, {device}, {' '.join(flags)}"] = environments[0], cuda + flags, 1
    with contextlib.ExitStack() as stack:
        programs = {}
        for i, (name, (environment, flags, most)) in enumerate(cases.items()):
            given = SimpleNamespace(cores=cores[i:] + cores[:i], flags=flags)  # to compile at once
            programs[name] = [
                stack.enter_context(bench.ours(algorithm, environment, given, name, job=job))
                for job in range(most)
            ]
        for _ in range(3):  # then what is compiled is compiled
            bench.advance(*sum(programs.values(), []))
        for name, group in programs.items():
            speeds = ["" for _ in jobs]
            for column, number in enumerate(jobs):
                if number <= len(group):
                    bench.measure(options, *group[:number])
                    total = sum(program.speeds[-1] for program in group[:number])
                    speeds[column] = f"{total:,.0f}"
            print(f"| {algorithm}, {name} | {' | '.join(speeds)} |", flush=True)
END

echo -e "\n$( ((failed)) && echo FAILED || echo passed) in $SECONDS seconds"
exit $failed
