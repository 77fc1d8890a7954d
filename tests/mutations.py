"""Whether the tests notice wrong code: each mutation below must make one of its tests fail.

    python tests/mutations.py          # some ten minutes on two cores
    python tests/mutations.py judge    # those whose name contains "judge"

Each works on a copy of the repository in a temporary folder.
"""

import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
SCRIPTS = ("mppo_beta_crane.py", "ppo_crane.py", "trpo_crane.py", "recurrent_ppo_crane.py")
PPOS = tuple(script for script in SCRIPTS if script != "trpo_crane.py")


class Mutation(NamedTuple):
    name: str
    files: tuple[str, ...]  # one run of the tests for each
    right: str
    wrong: str
    tests: str  # files of tests/ and words for `pytest -k`


MUTATIONS = [
    Mutation(
        "the judge takes a trial's last end",
        ("crane_trials.py",),
        "first = (terminated | truncated) & ~ended",
        "first = terminated | truncated",
        "test_trials",
    ),
    Mutation(
        "success counts after an episode's end",
        ("crane_trials.py",),
        "np.where(first,",
        "np.where(True,",
        "test_trials",
    ),
    Mutation(
        "returns count after an episode's end",
        ("crane_trials.py",),
        "np.where(first,",
        "np.where(first if name != 'episodic_return' else terminated | truncated,",
        "test_trials",
    ),
    Mutation(
        "the judge and evaluate() disagree",
        ("crane_trials.py",),
        "diameters, seeds = monte_carlo_trials(seed, trials)",
        "diameters, seeds = monte_carlo_trials(seed + 1, trials)",
        "test_trials",
    ),
    Mutation(
        "the judge's --stochastic is not seeded",
        ("eval_crane.py",),
        '        torch.manual_seed(args.seed)\n        options["pose_noise"] = noise',
        '        options["pose_noise"] = noise',
        "test_eval",
    ),
    Mutation(
        "the judge ignores --stochastic",
        ("eval_crane.py",),
        "seeds[chunk], not args.stochastic)",
        "seeds[chunk], True)",
        "test_eval",
    ),
    Mutation(
        "the judge ignores --contact",
        ("eval_crane.py",),
        'options |= {"contact": args.contact} if args.contact else {}',
        "",
        "test_eval",
    ),
    Mutation(
        "code in a policy or checkpoint runs",
        ("crane_policies.py", "crane_runs.py"),
        "weights_only=True",
        "weights_only=False",
        "test_failures -k code",
    ),
    Mutation(
        "the update starts from empty memories",
        ("recurrent_ppo_crane.py",),
        "mb_state = (first_state[0][mb], first_state[1][mb])",
        "mb_state = agent.initial_state(len(mb))",
        "test_scripts -k ratio",
    ),
    Mutation(
        "V(final_obs) without memory",
        ("recurrent_ppo_crane.py",),
        "cut_state = [part[cut] for part in state]",
        "cut_state = agent.initial_state(int(cut.sum()))",
        "test_scripts -k follows",
    ),
    Mutation(
        "bootstrapping from the next episode's start",
        SCRIPTS,
        'to_tensor(np.stack(info["final_obs"][cut]))',
        "next_obs[cut]",
        "test_scripts -k follows",
    ),
    Mutation(
        "no bootstrapping at the time limit",
        SCRIPTS,
        "if cut.any():",
        "if False:",
        "test_scripts -k follows",
    ),
    Mutation(
        "the warm-up forgets the options' difficulty",
        SCRIPTS,
        "envs.unwrapped.difficulty = full_difficulty * share",
        "envs.unwrapped.difficulty = share",
        "test_scripts -k warm_up",
    ),
    Mutation(
        "the warm-up never ends",
        SCRIPTS,
        "share = so_far / args.warm_up if so_far < args.warm_up else 1.0",
        "share = so_far",
        "test_scripts -k warm_up",
    ),
    Mutation(
        "jaws that close in the air earn as much as a grip",
        ("crane_task.py",),
        "np.minimum(closed, EMPTY_GRIP)",
        "closed",
        "test_rules -k closed",
    ),
    Mutation(
        "a log pinched above its centre pays as a firm grip",
        ("crane_task.py",),
        "np.clip(0.5 + grip_depth(state), 0, 1)",
        "1.0",
        "test_rules -k centre",
    ),
    Mutation(
        "an easy task punishes as the full one",
        ("crane_task.py",),
        "* difficulty**4 *",
        "*",
        "test_rules -k ground",
    ),
    Mutation(
        "a crane that stands on its jaws carries the log",
        ("crane_env.py",),
        "np.linalg.norm(support, axis=-1) + np.linalg.norm(pressure, axis=-1)",
        "np.linalg.norm(support, axis=-1)",
        "test_hydraulics -k carried",
    ),
    Mutation(
        "the anti-windup bound is three times too wide",
        ("crane_env.py",),
        "self.max_lead = self.model",
        "self.max_lead = 3 * self.model",
        "test_physics -k stop",
    ),
    Mutation(
        "a log reached after 6 s counts",
        ("crane_env.py",),
        "< crane_task.REACH_DISTANCE) & in_time",
        "< crane_task.REACH_DISTANCE)",
        "test_rules",
    ),
    Mutation(
        "no early stop at target_kl",
        PPOS,
        "np.mean(epoch_kls) > args.target_kl",
        "False",
        "test_scripts -k target_kl",
    ),
    Mutation(
        "weights that are not finite are saved",
        ("crane_runs.py",),
        "if wrong or not all(tensor.isfinite()",
        "if wrong or not any(tensor.isfinite()",
        "test_failures -k finite",
    ),
    Mutation(
        "resume ignores changed arguments",
        ("crane_runs.py",),
        "and name not in CHANGEABLE",
        "and False",
        "test_failures -k refuses",
    ),
    Mutation(
        "the final trials are written twice",
        ("crane_runs.py",),
        "if self.args.final_trials and not self.final_scores:",
        "if self.args.final_trials:",
        "test_failures -k finished",
    ),
    Mutation(
        "two resumes of one run",
        ("crane_runs.py",),
        "        lock.acquire()\n",
        "        pass\n",
        "test_failures -k second",
    ),
    Mutation(
        "a checkpoint is written in place",
        ("crane_runs.py",),
        '(self.dir / f"{name}.tmp").write_bytes(buffer.getvalue())',
        '(self.dir / f"{name}.pt").write_bytes(buffer.getvalue()[:99])',
        "test_failures -k full",
    ),
    Mutation(
        "a number's range is not checked",
        ("crane_options.py",),
        "good = numbers and all(low <= item <= high for item in items)",
        "good = numbers",
        "test_failures -k range",
    ),
    Mutation(
        "a crane that never succeeds repeats its failures",
        ("crane_env.py",),
        " * np.mean(self.recent_success[i] or 0.0)",
        "",
        "test_env -k retry",
    ),
    Mutation(
        "a crane's repeats depend on the others' success",
        ("crane_env.py",),
        "self.recent_success[i] or 0.0",
        "[x for ends in self.recent_success for x in ends] or 0.0",
        "test_env -k retry",
    ),
    Mutation(
        "NEXT_STEP counts an end twice",
        ("crane_env.py",),
        'ending[self.resting] = "none"',
        "pass",
        "test_env -k next_step",
    ),
    Mutation(
        "all joints get the oil that they ask for",
        ("machine.py",),
        "return mean * np.minimum(1, PUMP_FLOW / np.maximum(demand, 1e-9))",
        "return mean",
        "test_hydraulics -k pump",
    ),
    Mutation(
        "the telescope opens at once",
        ("machine.py",),
        "target[closed, 3] = 0.0",
        "pass",
        "test_hydraulics -k telescope",
    ),
    Mutation(
        "valves have no lag",
        ("machine.py",),
        "self.speed[ids] = target + (speed - target) * decay",
        "self.speed[ids] = target",
        "test_hydraulics -k lag",
    ),
    Mutation(
        "valves look too often at a short frame_skip",
        ("crane_env.py",),
        "ids = np.flatnonzero(due)",
        "ids = np.arange(self.num_envs)",
        "test_hydraulics -k frame_skip",
    ),
    Mutation(
        "the drawn speed gain is ignored",
        ("crane_env.py",),
        "wanted, seconds = (gain * command)[ids]",
        "wanted, seconds = command[ids]",
        "test_hydraulics -k gain",
    ),
    Mutation(
        "one jaw is enough to carry",
        ("crane_task.py",),
        "CARRY_WEIGHT * centred * held * state.carried",
        "CARRY_WEIGHT * centred * state.carried",
        "test_rules -k carrying",
    ),
    Mutation(
        "gentle ignores the force",
        ("crane_env.py",),
        'info["success"] & (info["ground_peak"] <= GENTLE_FORCE)',
        'info["success"]',
        "test_hydraulics -k gentle",
    ),
    Mutation(
        "costs go on in the next episode",
        ("machine.py",),
        "            cost[ids] = 0.0\n",
        "            pass\n",
        "test_hydraulics -k costs",
    ),
    Mutation(
        "ranks keep gradients of their own",
        ("mppo_beta_torchrun.py",),
        "nn.utils.vector_to_parameters(average(nn.utils.parameters_to_vector(grads)), grads)",
        "pass",
        "test_torchrun -k gradient or weights",
    ),
    Mutation(
        "ranks keep statistics of their own",
        ("mppo_beta_torchrun.py",),
        "adv = adv - average(adv.mean())",
        "adv = adv - adv.mean()",
        "test_torchrun -k gradient",
    ),
    Mutation(
        "ranks normalize by their own observations",
        ("mppo_beta_torchrun.py",),
        "mean = average(obs.mean(0))",
        "mean = obs.mean(0)",
        "test_torchrun -k gradient",
    ),
    Mutation(
        "a changed network is judged as if it were not",
        ("crane_policies.py",),
        "if actions.shape != expected.shape or not torch.allclose(actions, expected, atol=1e-3):",
        "if False:",
        "test_eval -k edited",
    ),
    Mutation(
        "an edited copy is judged under our name",
        ("crane_policies.py",),
        "algorithm if used in ours else used",
        "algorithm",
        "test_eval -k edited",
    ),
    Mutation(
        "a changed network goes on with a run",
        ("crane_runs.py",),
        'if not torch.allclose(actions, checkpoint["fingerprint"], atol=1e-3):',
        "if False:",
        "test_scripts -k changed_network",
    ),
    Mutation(
        "a stop evaluates before it saves",
        ("crane_runs.py",),
        "if stop or self.stop_signals:",
        "if False:",
        "test_failures -k saves_before",
    ),
    Mutation(
        "the judge's trials may be easy",
        ("eval_crane.py",),
        'options |= {"difficulty": 1.0, "retry": 0.0}',
        "options |= {}",
        "test_eval -k full_task",
    ),
    Mutation(
        "the scripted crane is judged at speeds that it does not know",
        ("eval_crane.py",),
        'if crane.options["speed"] != "real":',
        "if False:",
        "test_eval -k clear_errors",
    ),
    Mutation(
        "the scripted crane drives at speeds that it does not know",
        ("crane_view.py",),
        ', "speed": "real"}',
        "}",
        "test_view -k drives_only",
    ),
    Mutation(
        "a mean over policies of several tasks",
        ("eval_crane.py",),
        "if of == [task, noise]",
        "if of[1] == noise",
        "test_eval -k means_over",
    ),
    Mutation(
        "logs slip more easily in the same revision",
        ("assets/crane.xml",),
        'friction="0.5 0.02 0.005"',
        'friction="0.45 0.02 0.005"',
        "test_revision",
    ),
]


def run_tests(folder: Path, tests: str) -> int:
    """Exit status of pytest: 0 if all pass, 1 if some fail."""
    name, *words = tests.split(" -k ")
    line = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", f"tests/{name}.py"]
    line += ["-k", words[0]] if words else []
    return subprocess.run(line, cwd=folder, capture_output=True).returncode


def survivors(mutation: Mutation, file: str) -> str:
    """The mutation's name if no test fails, else an empty string."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "copy")
        left_out = shutil.ignore_patterns(".*", "runs", "__pycache__", "docs")
        shutil.copytree(ROOT, copy, ignore=left_out)
        code = (copy / file).read_text()
        (copy / file).write_text(code.replace(mutation.right, mutation.wrong))
        caught = mutation.right in code and run_tests(copy, mutation.tests) == 1
    print("caught  " if caught else "MISSED  ", f"{mutation.name} ({file})", flush=True)
    return "" if caught else f"{mutation.name} ({file})"


if __name__ == "__main__":
    words = " ".join(sys.argv[1:])
    for tests in sorted({m.tests for m in MUTATIONS if words in m.name}):
        if run_tests(ROOT, tests) != 0:
            sys.exit(f"{tests} fails without any mutation")
    jobs = [(m, file) for m in MUTATIONS for file in m.files if words in m.name]
    with ThreadPoolExecutor(2) as pool:
        missed = [name for name in pool.map(lambda job: survivors(*job), jobs) if name]
    print(f"{len(jobs) - len(missed)} of {len(jobs)} mutations caught")
    sys.exit("\n".join(missed) if missed else 0)
