"""`simrecon benchmark`: generates suites of tasks, runs and compares policies, records demonstrations."""

import argparse
from pathlib import Path

from reconstruction.commands.environments import run_by_name
from reconstruction.commands.options import SEEDS, add_common, add_verb, number, whole_number

_RUNNER = "simrecon_envs.benchmark.command"

_EPILOG = """from scenes to a comparison:
  simrecon benchmark generate --all --out suite.json --jobs 4        feasible tasks that waiting does not solve
  simrecon benchmark run suite.json --policy still --out still.json  succeeds in 0 %
  simrecon benchmark run suite.json --policy my_policy:Policy --split test --out mine.json --videos videos
  simrecon benchmark compare still.json mine.json                    paired by task and seed, with 95 % intervals
  simrecon benchmark demos suite.json --maniskill demos --lerobot dataset

options of a subcommand: `simrecon benchmark generate --help` and so on; see also docs/embodied_benchmarks.md."""

_POLICY = """a policy:
  class Policy:                                              # in my_policy.py, in this folder or installed
      policy_options = {"control_mode": "pd_joint_delta_pos", "obs_mode": "state"}   # arguments of gym.make
      def __init__(self, env): self.env = env                # Gymnasium, NumPy, not batched; once per task
      def reset(self): ...                                   # optional; called after every reset
      def act(self, observation): return self.env.action_space.sample()

Any callable works that takes the environment and returns such an object. `--policy-option model=net.zip` passes the
keyword argument model="net.zip" to it. Policies of `simrecon train` run as follows:
  simrecon benchmark run suite.json --policy simrecon_envs.training:trained --policy-option run=FOLDER"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb with its subcommands."""
    parser = add_verb(
        verbs,
        "benchmark",
        "generate suites of tasks, run and compare policies, record demonstrations",
        "Generate suites of tasks from scenes, run policies, compare their results, record demonstrations.",
        _EPILOG,
    )
    parts = parser.add_subparsers(dest="part", metavar="SUBCOMMAND", required=True)
    _add_generate(parts)
    _add_run(parts)
    _add_compare(parts)
    _add_demos(parts)


def _add_generate(parts: argparse._SubParsersAction) -> None:
    parser = add_verb(
        parts,
        "generate",
        "generate a suite of feasible tasks",
        "Generate a suite (JSON) of feasible tasks. A task is accepted if the oracle solves it from every seed, it is "
        "not solved at reset, and doing nothing does not solve it. The suite lists rejected tasks with the reason. "
        "A killed run resumes when it is started again.",
    )
    add = parser.add_argument
    add("scenes", nargs="*", metavar="SCENE", help="scenes of the registry")
    add("--all", action="store_true", help="all scenes of the registry")
    add("--out", type=Path, required=True, metavar="FILE", help="the suite, such as suite.json")
    add(
        "--kinds",
        type=_words,
        default=(),
        help="kinds of tasks, with commas: reach, pick, place, put, stack, push, rearrange, navigate, sequence (all)",
    )
    add(
        "--robots", type=_words, default=("panda", "fetch"), help="separated by commas (default: panda,fetch)"
    )
    add(
        "--per-scene",
        type=whole_number(1),
        default=30,
        metavar="N",
        help="most tasks of a scene (default: 30)",
    )
    add(
        "--seeds",
        type=whole_number(1, 1_000_000),
        default=5,
        metavar="N",
        help="number of episodes of a task (default: 5)",
    )
    add("--seed", type=whole_number(*SEEDS), default=0, help="seed of the episodes' seeds (default: 0)")
    add(
        "--test-share",
        type=number(0, 1),
        default=0.2,
        metavar="SHARE",
        help="share of scenes and objects in the test split, by the hashes of their names (default: 0.2)",
    )
    add(
        "--randomize",
        metavar="WHAT",
        help="randomization of episodes: none, all, or for example shift_m=0.03,turn_rad=0.3 (the default); see "
        "docs/environments.md",
    )
    _add_demo_flags(parser)
    _add_work(parser)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:generate"))


def _add_run(parts: argparse._SubParsersAction) -> None:
    parser = add_verb(
        parts,
        "run",
        "run a policy in a suite",
        "Run a policy in a suite. Reports success rate, path efficiency (success times the length of the oracle's path "
        "over the longer of both paths), steps and seconds, with 95 % intervals, by kind, scene, robot and split. A "
        "killed run with --out resumes when it is started again.",
        _POLICY,
    )
    add = parser.add_argument
    add("suite", type=Path, metavar="SUITE", help="output of `simrecon benchmark generate`")
    add("--policy", required=True, metavar="NAME", help="oracle, still, random, or module:callable (below)")
    add(
        "--policy-option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="keyword argument; may be repeated",
    )
    _add_choice(parser)
    add(
        "--timeout",
        type=number(0, 1e6),
        default=600.0,
        metavar="SECONDS",
        help="longest time of one call of the policy, of its making too; 0: no limit (default: 600)",
    )
    add("--out", type=Path, metavar="FILE", help="output file, for example results.json")
    add("--videos", type=Path, metavar="DIR", help="write a video of the first episode of each task")
    add(
        "--fresh-seeds",
        type=whole_number(0, 1_000_000),
        default=0,
        metavar="N",
        help="run N episodes of each task from seeds that are not in the suite, instead of its own",
    )
    _add_work(parser)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:run"))


def _add_compare(parts: argparse._SubParsersAction) -> None:
    parser = add_verb(
        parts,
        "compare",
        "compare two results",
        "Compare two results: second minus first, over the episodes that both contain. Intervals resample whole tasks; "
        "p is McNemar's exact test over episodes.",
    )
    parser.add_argument("first", type=Path, metavar="A.json", help="output of `simrecon benchmark run`")
    parser.add_argument("second", type=Path, metavar="B.json", help="another one of the same suite")
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:compare"))


def _add_demos(parts: argparse._SubParsersAction) -> None:
    parser = add_verb(
        parts,
        "demos",
        "record demonstrations of the oracle",
        "Record demonstrations of the oracle, one for each episode, in ManiSkill's trajectory format (one folder for "
        "each task; `python -m mani_skill.trajectory.replay_trajectory` replays them) and as a LeRobot dataset (v3.0; "
        "needs `pip install 'simrecon[lerobot]'`).",
    )
    parser.add_argument("suite", type=Path, metavar="SUITE", help="output of `simrecon benchmark generate`")
    _add_choice(parser)
    _add_demo_flags(parser, long=True)
    _add_work(parser, jobs=False)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:demos"))


def _add_choice(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--split", default="all", choices=("all", "train", "test"), help="default: all")
    add(
        "--split-by",
        default="object",
        choices=("object", "scene"),
        help="object: a task is in the test split if any of its objects is; scene: if its scene is (default: object)",
    )
    add("--tasks", default="*", metavar="GLOB", help="names, for example '*-push_*', separated by commas")
    add("--kinds", type=_words, default=(), help="only these kinds, separated by commas")
    add("--robots", type=_words, default=(), help="only these robots, separated by commas")
    add(
        "--episodes",
        type=whole_number(1),
        metavar="N",
        help="maximum number of episodes of a task (default: all)",
    )
    add(
        "--fetch-from",
        metavar="PLACE",
        help="pull scenes that the registry lacks, by the suite's revisions, from a folder, s3://, hf:// or others "
        "(default: $SIMRECON_SCENES_FROM; docs/sharing.md)",
    )
    add("--any-revision", action="store_true", help="accept scenes of another revision, with a note")


def _add_demo_flags(parser: argparse.ArgumentParser, long: bool = False) -> None:
    parser.add_argument(
        "--maniskill" if long else "--demos",
        dest="maniskill",
        type=Path,
        metavar="DIR",
        help="write demonstrations as ManiSkill trajectories (.h5 and .json)",
    )
    parser.add_argument(
        "--lerobot",
        type=Path,
        metavar="DIR",
        help="write demonstrations as LeRobot datasets v3.0, one for each robot (needs the extra lerobot)",
    )
    parser.add_argument(
        "--demo-obs",
        default="state_dict",
        metavar="MODE",
        help="observations: state_dict, or rgb and others if this machine can render (default: state_dict)",
    )
    parser.add_argument(
        "--demo-renderer",
        default="mesh",
        choices=("mesh", "splats"),
        help="images from the scene's meshes or from its Gaussians (default: mesh)",
    )


def _add_work(parser: argparse.ArgumentParser, jobs: bool = True) -> None:
    if jobs:
        parser.add_argument(
            "--jobs", type=whole_number(1, 10_000), default=1, metavar="N", help="processes (default: 1)"
        )
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    add_common(parser)


def _words(text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:
        raise argparse.ArgumentTypeError(f"expected names separated by commas, got {text!r}")
    return words
