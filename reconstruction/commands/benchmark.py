"""`simrecon benchmark`: a suite of tasks from scenes, policies in it, and what differs between them."""

import argparse
import textwrap
from pathlib import Path

from reconstruction.commands.environments import run_by_name

_RUNNER = "simrecon_envs.benchmark.command"

_EPILOG = """from scenes to a comparison:
  simrecon benchmark generate --all --out suite.json --jobs 4        tasks that can be done, and are not by waiting
  simrecon benchmark run suite.json --policy still --out still.json  0 %, or something is wrong
  simrecon benchmark run suite.json --policy my_policy:Policy --split test --out mine.json --videos videos
  simrecon benchmark compare still.json mine.json                    paired by task and seed, with 95 % intervals
  simrecon benchmark demos suite.json --maniskill demos --lerobot dataset

what each subcommand takes: `simrecon benchmark generate --help` and so on; docs/embodied_benchmarks.md says more."""

_POLICY = """a policy:
  class Policy:                                              # in my_policy.py, in this folder or installed
      policy_options = {"control_mode": "pd_joint_delta_pos", "obs_mode": "state"}   # what gym.make shall get
      def __init__(self, env): self.env = env                # Gymnasium, NumPy, not batched; once a task
      def reset(self): ...                                   # may be left out; after every reset
      def act(self, observation): return self.env.action_space.sample()

Any callable that takes the environment and returns such an object will do. `--policy-option model=net.zip` is given to
it as the keyword argument model="net.zip". What `simrecon train` trained is a policy, too:
  simrecon benchmark run suite.json --policy simrecon_envs.training:trained --policy-option run=FOLDER"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb with its subcommands."""
    parser = verbs.add_parser(
        "benchmark",
        help="make a suite of tasks from scenes, run policies in it, compare them, record demonstrations",
        description="Make a suite of tasks from scenes, run policies in it, compare them, record demonstrations.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parts = parser.add_subparsers(dest="part", metavar="SUBCOMMAND", required=True)
    _add_generate(parts)
    _add_run(parts)
    _add_compare(parts)
    _add_demos(parts)


def _add_generate(parts: argparse._SubParsersAction) -> None:
    parser = _part(
        parts,
        "generate",
        "prove tasks in scenes and write them as a suite",
        "Prove tasks in scenes and write them as a suite (JSON). A task is taken if the oracle does it from every "
        "seed, it is not done at reset, and doing nothing to the end does not do it. What is left out is in the "
        "suite, with the reason. A run that was killed goes on where it was when it is started again.",
    )
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="scenes of the registry")
    parser.add_argument("--all", action="store_true", help="all scenes of the registry")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="the suite, such as suite.json"
    )
    parser.add_argument(
        "--kinds",
        type=_words,
        default=(),
        help="kinds of tasks, with commas: reach, pick, place, put, stack, push, rearrange, navigate, sequence (all)",
    )
    parser.add_argument(
        "--robots", type=_words, default=("panda", "fetch"), help="with commas (default: panda,fetch)"
    )
    parser.add_argument(
        "--per-scene", type=int, default=30, metavar="N", help="most tasks of a scene (default: 30)"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="episodes of a task (default: 5)")
    parser.add_argument(
        "--seed", type=int, default=0, help="what the episodes' seeds are made of (default: 0)"
    )
    parser.add_argument(
        "--test-share",
        type=float,
        default=0.2,
        metavar="SHARE",
        help="how many scenes and objects are on the side test, by the hashes of their names (default: 0.2)",
    )
    parser.add_argument(
        "--randomize",
        metavar="WHAT",
        help="what differs from episode to episode: none, all, or such as shift_m=0.03,turn_rad=0.3 (the default); "
        "see docs/environments.md",
    )
    _add_demo_flags(parser)
    _add_work(parser)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:generate"))


def _add_run(parts: argparse._SubParsersAction) -> None:
    parser = _part(
        parts,
        "run",
        "run a policy in a suite",
        "Run a policy in a suite: success rate, path efficiency (success times the oracle's way over the longer of "
        "both), steps and seconds, with 95 % intervals, by kind, scene, robot and split. A run with --out that was "
        "killed goes on where it was.",
        _POLICY,
    )
    parser.add_argument("suite", type=Path, metavar="SUITE", help="a file of `simrecon benchmark generate`")
    parser.add_argument(
        "--policy",
        required=True,
        metavar="NAME",
        help="oracle, still, random, or module:callable (see below)",
    )
    parser.add_argument(
        "--policy-option",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="given to the callable as a keyword argument; may be repeated",
    )
    _add_choice(parser)
    parser.add_argument("--out", type=Path, metavar="FILE", help="the results, such as results.json")
    parser.add_argument("--videos", type=Path, metavar="DIR", help="a video of each task's first episode")
    parser.add_argument(
        "--fresh-seeds",
        type=int,
        default=0,
        metavar="N",
        help="N episodes of each task from seeds that are not the suite's, in place of those",
    )
    _add_work(parser)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:run"))


def _add_compare(parts: argparse._SubParsersAction) -> None:
    parser = _part(
        parts,
        "compare",
        "say what differs between two results",
        "Say what differs between two results: the second less the first, over the episodes that both have. Intervals "
        "draw whole tasks anew; p is McNemar's exact test over episodes.",
    )
    parser.add_argument("first", type=Path, metavar="A.json", help="results of `simrecon benchmark run`")
    parser.add_argument("second", type=Path, metavar="B.json", help="others, of the same suite")
    parser.add_argument("--json", action="store_true", help="print JSON for programs instead of text")
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:compare"))


def _add_demos(parts: argparse._SubParsersAction) -> None:
    parser = _part(
        parts,
        "demos",
        "record the oracle's demonstrations of a suite",
        "Record the oracle's demonstrations of a suite, one an episode: in ManiSkill's trajectory format (a folder a "
        "task; `python -m mani_skill.trajectory.replay_trajectory` replays them) and as a LeRobot dataset (v3.0; needs "
        "`pip install 'simrecon[lerobot]'`).",
    )
    parser.add_argument("suite", type=Path, metavar="SUITE", help="a file of `simrecon benchmark generate`")
    _add_choice(parser)
    _add_demo_flags(parser, long=True)
    _add_work(parser, jobs=False)
    parser.set_defaults(run=run_by_name(f"{_RUNNER}:demos"))


def _part(
    parts: argparse._SubParsersAction, name: str, summary: str, description: str, epilog: str | None = None
) -> argparse.ArgumentParser:
    return parts.add_parser(
        name,
        help=summary,
        description=textwrap.fill(description, 100),
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter if epilog else argparse.HelpFormatter,
    )


def _add_choice(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--split", default="all", choices=("all", "train", "test"), help="default: all")
    parser.add_argument(
        "--split-by",
        default="object",
        choices=("object", "scene"),
        help="whose side counts: a task is on the side test by object if any of its objects is (default: object)",
    )
    parser.add_argument("--tasks", default="*", metavar="GLOB", help="names, such as '*-push_*', with commas")
    parser.add_argument("--kinds", type=_words, default=(), help="only these kinds, with commas")
    parser.add_argument("--robots", type=_words, default=(), help="only these robots, with commas")
    parser.add_argument("--episodes", type=int, metavar="N", help="most episodes of a task (default: all)")
    parser.add_argument(
        "--any-revision", action="store_true", help="go on where a scene has another revision, and note it"
    )


def _add_demo_flags(parser: argparse.ArgumentParser, long: bool = False) -> None:
    parser.add_argument(
        "--maniskill" if long else "--demos",
        dest="maniskill",
        type=Path,
        metavar="DIR",
        help="the oracle's demonstrations as trajectories of ManiSkill (.h5 and .json)",
    )
    parser.add_argument(
        "--lerobot",
        type=Path,
        metavar="DIR",
        help="the oracle's demonstrations as LeRobot datasets v3.0, one a robot (needs the extra lerobot)",
    )
    parser.add_argument(
        "--demo-obs",
        default="state_dict",
        metavar="MODE",
        help="what demonstrations observe: state_dict, or rgb and the like where this machine renders (default: "
        "state_dict)",
    )


def _add_work(parser: argparse.ArgumentParser, jobs: bool = True) -> None:
    from reconstruction.commands.options import add_common

    if jobs:
        parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    add_common(parser)


def _words(text: str) -> tuple[str, ...]:
    words = tuple(word.strip() for word in text.split(",") if word.strip())
    if not words:
        raise argparse.ArgumentTypeError(f"expected names with commas, got {text!r}")
    return words
