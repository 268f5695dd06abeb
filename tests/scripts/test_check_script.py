"""tools/check_script.py: each of its lines turns red where a script is broken for it."""

import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import check_script
import numpy as np
import pytest
import torch
import torch._inductor.config
import watched_run
from check_script import BrokenError, Trial

import ppo_continuous_noisy as ppo

ROOT = Path(__file__).parents[2]


def broken(folder, algorithm, *replacements, name="broken_continuous_noisy.py"):
    """Return a trial of a copy of a script, with texts replaced that it has once."""
    text = (ROOT / f"{algorithm}_continuous_noisy.py").read_text()
    for old, new in replacements:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / name).write_text(text)
    return Trial(folder / name, [], folder)


def reason(promise, trial):
    """Return why a promise is broken."""
    with pytest.raises(BrokenError) as error:
        promise(trial)
    return str(error.value)


def before(text, line):
    """Put a line before a text that is indented as it is."""
    indent = " " * (len(text) - len(text.lstrip()))
    return text, f"{indent}{line}\n{text}"


MISSING = "put all that training changes into `state`"
LOSS = "    loss = -q1.mean()\n"
INPUTS = "inputs = torch.cat([observations, actions], 1)"
COMPARED = "self.config = noisy.resumed_run(old, new)"
IMPORT = before("import contextlib\n", "import copy")
MISTAKES = {  # the promise, the script and what is said: the texts that are replaced
    ("trains", "td3", "nothing was updated"): [("if global_step > args.learning_starts:", "if 0:")],
    ("trains", "ppo", "learns other values"): [
        ("self.critic(observations).squeeze(1)", "2 * self.critic(observations).squeeze(1)")
    ],
    ("trains", "ppo", "and learns another"): [  # acts with a copy that was right at the start
        IMPORT,
        before("        self.actor_logstd = nn.", "self.first = copy.deepcopy(self.actor_mean)"),
        ("in_numpy(agent.actor_mean, device), agent", "in_numpy(agent.first, device), agent"),
    ],
    ("acts", "td3", "actions in training are"): [
        IMPORT,
        before("    online_parameters = [*actor", "first_actor = copy.deepcopy(actor)"),
        ("action = actor.policy(observation, ", "action = first_actor.policy(observation, "),
    ],
    ("acts", "sac", "actor_loss() learns actions"): [  # others, in the second dimension
        ("        return actions, log", "        return squashed * self.action_scale, log")
    ],
    ("trains", "sac", "steps tensors that its update does not learn"): [
        ("Adam(actor.parameters(), ", "Adam([*actor.parameters(), *critic.parameters()], ")
    ],
    ("trains", "td3", "changes an observation in place"): [
        before("            action = actor.policy(observation, eps)", "observation += 0.1")
    ],
    ("trains", "td3", "makes (16, 16) of (16, 1) and (16,)"): [(".squeeze(1) for", " for")],
    ("trains", "td3", "critic_loss() learns a layer that was replaced"): [
        before("            curves |= update_critic(", "critic.networks[0][4] = nn.Linear(256, 1)")
    ],
    ("trains", "sac", "takes a time limit for an end"): [
        (", terminated, truncated)\n        obs", ", terminated or truncated, False)\n        obs")
    ],
    ("learns", "ppo", "no gradient of critic."): [(" + args.vf_coef * value_loss, c", ", c")],
    ("learns", "td3", "critic_loss() never changes"): [
        ("critic.parameters(), lr=args.learning_rate", "critic.parameters(), lr=0.0")
    ],
    ("follows", "ppo", "'scheduler' never changes"): [
        before('    state = {"agent"', "scheduler = torch.optim.lr_scheduler.LinearLR(optimizer)"),
        ('"rollout": rollout}', '"rollout": rollout, "scheduler": scheduler}'),
    ],
    ("follows", "sac", "scale of 'target'"): [  # a buffer
        (INPUTS, f"{INPUTS} / self.scale"),
        before("        self.networks = nn.", 'self.register_buffer("scale", torch.ones(1))'),
        before("            curves |= update_critic(", "critic.scale += 0.01"),
    ],
    ("follows", "td3", "'target_actor' is 'actor' itself"): [
        before("    q_optimizer = torch", "target_actor, target_critic = actor, critic")
    ],
    ("follows", "sac", "0.networks.0.0.weight of 'target' never changes"): [
        before("    alpha = torch.tensor(", "target = nn.Sequential(target)"),
        ("target(next_observations, next_actions)", "target[0](next_observations, next_actions)"),
        ("target_param.lerp_(param, args.tau)", "pass"),
    ],
    ("resumes", "sac", MISSING): [  # which changes after the first stop
        before("    target_entropy = -", "scale = 1.0"),
        before("        # STEP\n", "scale = 2.0 if global_step == 90 else scale"),
        ("actor.policy(observation, eps)", "actor.policy(observation, scale * eps)"),
    ],
    ("resumes", "td3", "another eval.csv from step "): [  # counts updates, and is not resumed
        before("    online_parameters = [*actor", "updates = 0"),
        before("            if global_step % args.policy_frequency == 0:", "updates += 1"),
        ("global_step % args.policy_frequency", "updates % args.policy_frequency"),
    ],
    ("resumes", "ppo", "ask stop()"): [("stopping = stop()", "stopping = 0")],
    ("trains", "sac", "test in test_env alone"): [("noisy.play(test_env, ", "noisy.play(env, ")],
    ("tests", "sac", "change nothing while testing"): [
        before("            results = noisy.play(", "torch.randn(1)")
    ],
    ("compiles", "td3", "of actor_loss() by"): [
        before(LOSS, "q1 = q1 * (1.001 if torch.compiler.is_compiling() else 1.0)")
    ],
    ("compiles", "td3", "not compiled"): [before(LOSS, "torch._dynamo.graph_break()")],
    ("options", "ppo", "it holds a run with begun"): [
        before("    num_steps: int = 2048", "begun: float = time.time()")
    ],
    ("options", "ppo", "leave resumed_run() in Run"): [(COMPARED, "self.config = new")],
    ("evaluates", "ppo", "let load_policy() build"): [
        ("    return make_policy(agent, obs", "    return make_policy(Agent(env), obs")
    ],
    ("analyses", "ppo", "eval.csv"): [('self.eval_csv += f"{due},', 'self.eval_csv += f"first,')],
}
SLOW = ("acts", "follows", "resumes", "tests", "compiles", "options", "evaluates", "analyses")


@pytest.mark.parametrize(
    "mistake",
    [pytest.param(one, marks=[pytest.mark.slow] * (one[0] in SLOW)) for one in MISTAKES],
    ids=lambda mistake: f"{mistake[0]}: {mistake[2]}",
)
def test_a_promise_is_red_where_it_is_broken(mistake, tmp_path):
    promise, algorithm, said = mistake
    trial = broken(tmp_path, algorithm, *MISTAKES[mistake])
    assert said in reason(getattr(check_script, promise), trial)


@pytest.mark.slow
def test_something_is_missing_in_the_state_where_episodes_are_short(tmp_path):
    """The run stops when all has been learned once, though four episodes ended long before."""
    old = '"q_optimizer": q_optimizer, "actor_optimizer": actor_optimizer}'
    trial = broken(tmp_path, "td3", (old, '"actor_optimizer": actor_optimizer}'))
    trial.options = ["--max-episode-steps", "5"]
    assert MISSING in reason(check_script.resumes, trial)


@pytest.mark.slow
def test_a_name_that_the_sweep_does_not_know(tmp_path):
    trial = broken(tmp_path, "ppo", name="broken.py")
    assert "unknown algorithm" in reason(check_script.sweeps, trial)


@pytest.mark.slow
@torch._inductor.config.patch({"cpp.cxx": ("no-such-compiler",)})
def test_no_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    assert "no C++ compiler" in check_script.compiles(broken(tmp_path, "td3"))


def test_a_line_for_each_promise(tmp_path, capsys, monkeypatch):
    def fails(trial):
        """Another promise holds."""
        raise BrokenError("it does not: change it")

    def crashes(trial):
        """A third promise holds."""
        raise ZeroDivisionError("of the script's own")

    def holds(trial):
        """A promise holds."""

    path = broken(tmp_path, "ppo").path
    names = {promise.__name__ for promise in check_script.PROMISES}
    assert names == {"sweeps", *(promise for promise, *_ in MISTAKES)}
    monkeypatch.setattr(check_script, "PROMISES", [holds, fails, crashes])
    assert check_script.main(path) == 1
    out, err = capsys.readouterr()
    assert out.splitlines() == [
        "ok      A promise holds",
        "FAILED  Another promise holds: it does not: change it",
        "FAILED  A third promise holds: of the script's own",
    ]
    assert "ZeroDivisionError" in err
    monkeypatch.setattr(check_script, "PROMISES", [holds])
    assert check_script.main(path) == 0
    capsys.readouterr()
    assert check_script.main("no.py") == check_script.main("--help") == check_script.main() == 2
    assert "error: there is no file no.py, or its name is not " in capsys.readouterr().err


def test_no_more_than_a_line_where_it_does_not_train(tmp_path, capsys):
    path = broken(tmp_path, "ppo", before("    # SETUP\n", "fail('no', 1)")).path
    assert check_script.main(path) == 1
    assert capsys.readouterr().out == "FAILED  It trains: error: no\n"
    for word in ("--no-such-option", "--gamma=2"):
        with pytest.raises(SystemExit) as exit_:
            check_script.main(broken(tmp_path, "ppo").path, word)
        out, err = capsys.readouterr()
        assert (exit_.value.code, out, err.count("\n")) == (2, "", 1)
        assert err.startswith("error: ") and word.partition("=")[0] in err


def test_a_part_that_two_optimizers_hold_is_told(tmp_path):
    layer = before("    actor_optimizer = torch", "actor.network[2] = critic.networks[0][2]")
    assert "and actor_loss() share 2 tensors" in check_script.trains(broken(tmp_path, "sac", layer))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            before("    update_critic = up", "[p.register_hook(abs) for p in critic.parameters()]"),
            "critic_loss() is learned by another gradient than autograd's",
        ),
        (
            (INPUTS, "inputs = torch.cat([observations, self.encoder[0](actions)], 1)"),
            "critic_loss() depends on 2 tensors outside its modules that nothing learns",
        ),
    ],
)
def test_a_gradient_that_is_lost_is_told(change, told, tmp_path):
    """The script itself trains as if nothing were wrong."""
    layer = before("        self.networks = nn.", "self.encoder = [nn.Linear(1, 1)]")
    assert f"({told})" in check_script.trains(broken(tmp_path, "sac", layer, change))


def test_what_is_right_is_told_by_no_word(tmp_path):
    """A layer that is frozen at first, and a number that a loss knows to be a tensor."""
    frozen = "actor.network[0].requires_grad_(global_step > 60)"
    right = [before("            curves |= update_critic(", frozen)]
    right.append((" * gamma * next", " * gamma.square().sqrt() * next"))
    # errors of each sample, as for priorities, that are no curve
    right.append(("return loss, values | losses", 'return loss, values | {"errors": q1 - y}'))
    right.append(before("            # LEARN: actor", 'curves.pop("errors")'))
    assert check_script.trains(broken(tmp_path, "td3", *right)) == ""


def test_networks_that_are_asked_at_once_broadcast_as_one_does():
    told = pytest.raises(BrokenError, match=r"loss\(\) makes \(16, 16\) of")
    with told, watched_run.Broadcasts("loss"):
        torch.zeros(2, 16, 1) - torch.zeros(16)
    with watched_run.Broadcasts("loss"):
        torch.zeros(2, 16) - torch.zeros(16), torch.zeros(2, 16, 1) - torch.zeros(16, 1)


def test_what_is_given_and_not_used_is_told(tmp_path):
    changes = [
        ("target_critic(next_observations, target_a", "critic(next_observations, target_a"),
        ("(1 - terminated) * gamma * next", "0.99 * next"),
        before("    learning_starts: int = ", "hidden_units: int = 64"),
    ]
    told = check_script.trains(broken(tmp_path, "td3", *changes))
    names = ("target_critic", "batch[4]", "gamma")
    expected = [f" (critic_loss() does not depend on {name})" for name in names]
    assert told == "".join(expected) + " (nothing reads --hidden-units)"


def test_an_item_of_a_minibatch_that_another_loss_uses_is_no_remark():
    batch, network = [torch.ones(3), torch.ones(3)], torch.nn.Linear(1, 1)

    def update(name, loss):
        more = {"loss": loss, "network": network, "inputs": [batch], "optimizer": None}
        more |= {"stepped": set(), "strays": set(), "gradient_gap": 0}
        return SimpleNamespace(name=name, **more)

    updates = [update("a", lambda network, batch: (batch[0].sum(), {}))]
    args = ppo.Args()
    seen = SimpleNamespace(idle=[], updates=updates, script=ppo, args=args)
    assert "a() does not depend on batch[1]" in "".join(watched_run.remarks(seen))
    updates.append(update("b", lambda network, batch: (batch[1].sum(), {})))
    assert "does not depend" not in "".join(watched_run.remarks(seen))


def test_a_gradient_in_one_update_will_do():
    """Another loss may leave a shared part of the network without one."""
    shared = torch.ones(1)
    update = SimpleNamespace(name="loss", parameters={"x": shared}, before={"x": torch.zeros(1)})
    seen = SimpleNamespace(updates=[update], with_gradient={id(shared)})
    check_script.learns(SimpleNamespace(run=seen))


def test_options_of_the_grid_are_none_of_the_scripts_in_a_sweep(tmp_path):
    words = "--total_timesteps=99 --noise A B --seed -1 --hidden=64 --env-kwargs g:1"
    trial = Trial(Path("my_continuous_noisy.py"), words.split(), tmp_path)
    assert trial.own_options == ["--hidden=64", "--env-kwargs", "g:1"]


EPISODES = [[0.1, 0.2, 0.3], [1.1, 1.2, 1.3, 1.4]]  # each ends at the time limit
PLACES = {
    np.float32([x, 0]).tobytes(): [SimpleNamespace(episode=i, step=t, at_limit=x == episode[-1])]
    for i, episode in enumerate(EPISODES)
    for t, x in enumerate(episode)
}
BEFORE, AFTER = [0.1, 0.2, 1.1, 1.2, 1.3], [0.2, 0.3, 1.2, 1.3, 1.4]
REWARDS, AT_LIMIT = [1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 1.0, 0.0, 0.0, 1.0]
DISCOUNTS = [0.9 * (1 - x) for x in AT_LIMIT]


@pytest.mark.parametrize(
    ("before", "after", "numbers", "said"),
    [
        (BEFORE, AFTER, [REWARDS, [0.0] * 5], ""),
        (BEFORE, [0.3, 0.3, 1.4, 1.4, 1.4], [REWARDS, [0.0] * 5], ""),  # some steps later
        ([9.0, *BEFORE[1:]], [-9.0, *AFTER[1:]], [REWARDS, [0.0] * 5], ""),  # of a model
        (BEFORE, AFTER, [REWARDS, [0.0] * 5, AT_LIMIT], ""),  # terminated, and truncated
        (BEFORE, AFTER, [REWARDS, [0.9] * 5, AT_LIMIT], ""),  # a discount, and truncated
        (BEFORE, AFTER[1:], [REWARDS, AT_LIMIT], ""),  # the batches of a discriminator
        (AFTER, BEFORE, [], ""),  # an inverse model
        (BEFORE, AFTER, [REWARDS, AT_LIMIT], "takes a time limit for an end"),
        (BEFORE, AFTER, [REWARDS, DISCOUNTS], "takes a time limit for an end"),
        (AFTER, BEFORE, [REWARDS, [0.0] * 5], "give s before s'"),
        (BEFORE, BEFORE, [REWARDS, [0.0] * 5], "does not come later"),
        (BEFORE, [0.2, 1.1, *AFTER[2:]], [REWARDS, [0.0] * 5], "before reset()"),
    ],
)
@pytest.mark.parametrize("shape", [(-1,), (-1, 1)])
def test_transitions_are_those_of_the_environment(before, after, numbers, said, shape):
    batch = [torch.tensor([(x, 0.0) for x in column]) for column in (before, after)]
    batch += [torch.tensor(column).reshape(shape) for column in numbers]
    with pytest.raises(BrokenError, match=re.escape(said)) if said else nullcontext():
        watched_run.check_transitions("loss", [batch, 0.99], PLACES)


@pytest.mark.slow
def test_an_option_may_leave_an_update_out(tmp_path):
    trial = broken(tmp_path, "sac")
    trial.options = ["--no-autotune"]
    assert "nothing learns by temperature_loss()" in check_script.trains(trial)
    check_script.follows(trial)
    check_script.resumes(trial)
