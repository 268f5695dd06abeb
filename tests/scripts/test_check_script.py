"""tools/check_script.py: each of its lines turns red where a script is broken for it."""

from pathlib import Path

import check_script
import pytest
import torch
import torch._inductor.config
from check_script import BrokenError, Trial

ROOT = Path(__file__).parents[2]
IMPORT = ("import contextlib\n", "import contextlib\nimport copy\n")


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


def test_a_script_that_never_learns(tmp_path):
    trial = broken(tmp_path, "td3", ("if global_step > args.learning_starts:", "if False:"))
    assert "nothing was updated" in reason(check_script.trains, trial)


def test_a_formula_of_acting_alone(tmp_path):
    old = "actions, _, _ = self(observations, eps)"
    trial = broken(tmp_path, "sac", (old, old.replace("eps)", "eps)[0].clamp(0.3, 0.4), 0, 0")))
    assert "actor_loss() learns actions" in reason(check_script.acts, trial)


def test_a_formula_of_learning_alone(tmp_path):
    old = "z = (actions - self.actor_mean(observations)) / self"
    trial = broken(tmp_path, "ppo", (old, old.replace("(observations)", "(observations).relu()")))
    assert "acts with one policy and learns another" in reason(check_script.trains, trial)


def test_acting_with_a_copy_that_was_right_at_the_start(tmp_path):
    setup = "        self.actor_logstd = nn.Parameter"
    copied = (setup, "        self.first = copy.deepcopy(self.actor_mean)\n" + setup)
    acting = ("in_numpy(self.actor_mean), self", "in_numpy(self.first), self")
    trial = broken(tmp_path, "ppo", IMPORT, copied, acting)
    assert "acts with one policy and learns another" in reason(check_script.trains, trial)


def test_acting_with_an_old_copy(tmp_path):
    setup = "    online_parameters = [*actor"
    acting = "action = actor.policy(observation, eps)"
    copied = (setup, "    first_actor = copy.deepcopy(actor)\n" + setup)
    trial = broken(tmp_path, "td3", IMPORT, copied, (acting, "action = first_" + acting[9:]))
    assert "actions in training are" in reason(check_script.acts, trial)


def test_saving_another_network(tmp_path):
    setup, saved = "    target_entropy = -", '{"actor": actor.state_dict()}'
    copied = (setup, "    first = copy.deepcopy(actor.state_dict())\n" + setup)
    trial = broken(tmp_path, "sac", IMPORT, copied, (saved, '{"actor": first}'))
    assert "load_policy()" in reason(check_script.acts, trial)


def test_a_network_that_the_loss_does_not_use(tmp_path):
    old = " + args.vf_coef * value_loss, curves"
    trial = broken(tmp_path, "ppo", (old, ", curves"))
    assert "no gradient of critic." in reason(check_script.learns, trial)


def test_an_optimizer_of_another_network(tmp_path):
    old = "q_optimizer = torch.optim.Adam(critic."
    trial = broken(tmp_path, "sac", (old, old.replace("critic", "target")))
    assert "critic_loss() never changes" in reason(check_script.learns, trial)


def test_targets_that_never_move(tmp_path):
    old = "target_parameters = [*target_actor.parameters(), *target_critic.parameters()]"
    trial = broken(tmp_path, "td3", (old, old.replace("*target_actor.parameters(), ", "")))
    trial.path.write_text(trial.path.read_text().replace("[*actor.parameters(), *cri", "[*cri"))
    assert "network.0.weight of 'target_actor'" in reason(check_script.follows, trial)


def test_targets_that_never_move_in_their_buffers(tmp_path):
    networks = "        self.networks = nn."
    buffer = '        self.register_buffer("scale", torch.ones(1))\n'
    inputs = "        inputs = torch.cat([observations, actions], 1)"
    learning = "            curves = update_critic("
    trial = broken(
        tmp_path,
        "sac",
        (networks, buffer + networks),
        (inputs, inputs + " / self.scale"),
        (learning, "            critic.scale += 0.01\n" + learning),
    )
    assert "scale of 'target'" in reason(check_script.follows, trial)


def test_something_is_missing_in_the_state_where_episodes_are_short(tmp_path):
    """The run stops when all has been learned once, though four episodes ended long before."""
    old = '"q_optimizer": q_optimizer, "actor_optimizer": actor_optimizer}'
    trial = broken(tmp_path, "td3", (old, '"actor_optimizer": actor_optimizer}'))
    trial.options = ["--max-episode-steps", "5"]
    assert "put all that training changes into `state`" in reason(check_script.resumes, trial)


def test_something_is_missing_in_the_state(tmp_path):
    old = 'state |= {"target_actor": target_actor, "target_critic": target_critic}'
    trial = broken(tmp_path, "td3", (old, 'state |= {"target_critic": target_critic}'))
    assert "put all that training changes into `state`" in reason(check_script.resumes, trial)


def test_a_run_that_does_not_stop(tmp_path):
    trial = broken(tmp_path, "ppo", ("stopping = stop()", "stopping = 0"))
    assert "ask stop()" in reason(check_script.resumes, trial)


def test_tests_that_train(tmp_path):
    trial = broken(tmp_path, "sac", ("noisy.play(test_env, ", "noisy.play(env, "))
    assert "play in test_env" in reason(check_script.tests, trial)


@pytest.mark.slow
def test_a_compiled_loss_that_is_another(tmp_path):
    old = "loss = -q1.mean()\n"
    new = "q1 = q1 * (1.001 if torch.compiler.is_compiling() else 1.0)\n    " + old
    trial = broken(tmp_path, "td3", (old, new))
    assert "of actor_loss() by" in reason(check_script.compiles, trial)


@pytest.mark.slow
def test_a_loss_that_cannot_be_compiled(tmp_path):
    old = "loss = -q1.mean()\n"
    trial = broken(tmp_path, "td3", (old, "torch._dynamo.graph_break()\n    " + old))
    assert "not compiled" in reason(check_script.compiles, trial)


@pytest.mark.slow
@torch._inductor.config.patch({"cpp.cxx": ("no-such-compiler",)})
def test_no_compiler(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path / "cache"))
    assert "no C++ compiler" in check_script.compiles(broken(tmp_path, "td3"))


def test_an_option_whose_default_changes(tmp_path):
    old = "    num_steps: int = 2048"
    trial = broken(tmp_path, "ppo", (old, "    begun: float = time.time()\n" + old))
    assert "it holds a run with begun" in reason(check_script.options, trial)


def test_options_that_are_not_compared(tmp_path):
    old = "self.config = noisy.resumed_run(old, new)"
    trial = broken(tmp_path, "ppo", (old, "self.config = new"))
    assert "leave resumed_run() in Run" in reason(check_script.options, trial)


@pytest.mark.slow
def test_a_name_that_the_sweep_does_not_know(tmp_path):
    trial = broken(tmp_path, "ppo", name="broken.py")
    assert "unknown algorithm" in reason(check_script.sweeps, trial)


@pytest.mark.slow
def test_a_policy_that_is_loaded_otherwise(tmp_path):
    old = "    return make_policy(agent, observation_stats, env)"
    new = "    return make_policy(Agent(env), observation_stats, env)"
    trial = broken(tmp_path, "ppo", (old, new))
    assert "let load_policy() build" in reason(check_script.evaluates, trial)


@pytest.mark.slow
def test_tests_that_are_not_stored(tmp_path):
    old = 'self.eval_csv += f"{due},'
    trial = broken(tmp_path, "ppo", (old, old.replace("{due}", "first")))
    assert "eval.csv" in reason(check_script.analyses, trial)


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
    assert "error: there is no script 'no.py'\n" in capsys.readouterr().out


def test_no_more_than_a_line_where_it_does_not_train(tmp_path, capsys):
    old = "    # SETUP\n"
    assert check_script.main(broken(tmp_path, "ppo", (old, "    fail('no', 1)\n" + old)).path) == 1
    assert capsys.readouterr().out == "FAILED  It trains: error: no\n"
