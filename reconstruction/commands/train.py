"""`simrecon train`: a policy for a task in a scene, by reinforcement learning."""

import argparse
from pathlib import Path

from reconstruction.commands.environments import run_by_name

_DESCRIPTION = """Train a policy for a task in SCENE by reinforcement learning (stable-baselines3), on the processor:
one environment a process. At the end it is evaluated on seeds that it was not trained on, and filmed. Everything is
in one folder: what was asked for, checkpoints, TensorBoard's curves, results.json, video.mp4."""

_EPILOG = """what to know:
  success      `simrecon show SCENE` and simrecon_envs.list_tasks say what can be done; reach takes a few minutes,
               picking up and what follows from it some millions of steps
  start        every episode begins differently (--randomize start): things shifted by up to 5 cm and turned, the
               arm's joints by up to 0.05 rad; all of it by --seed. The same seed and --envs give the same policy
  interrupt    Ctrl-C finishes the update and writes a checkpoint; what a kill leaves is the checkpoint of at most a
               minute before. --resume goes on with either, to the same number of steps
  curves       tensorboard --logdir ~/.simrecon/runs
  afterwards   simrecon_envs.training.load_policy(FOLDER) is the policy: observation -> action

examples:
  simrecon train scene0001 --task reach
  simrecon train scene0001 --task push_tray --algo sac --steps 100000 --seed 3
  simrecon train scene0001 --task reach --set learning_rate=3e-4 --set net_arch=128,128
  simrecon train scene0001 --resume                      the last run of this scene, task and algorithm
  simrecon train scene0001 --resume --out FOLDER --steps 300000       longer than it was begun with
  simrecon train --algo sac --list-settings
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Register the verb."""
    from reconstruction.commands.options import add_common

    parser = verbs.add_parser(
        "train",
        help="train a policy for a task in a scene",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", metavar="SCENE", nargs="?", help="a scene id, for example scene0001")
    parser.add_argument(
        "--task", default="reach", help="a kind (reach, pick ...) or a task's name (default: reach)"
    )
    parser.add_argument("--algo", default="ppo", choices=("ppo", "sac"), help="default: ppo")
    parser.add_argument("--robot", help="a robot of ManiSkill (default: panda)")
    parser.add_argument("--obs-mode", choices=("state", "rgb"), help="what is observed (default: state)")
    parser.add_argument(
        "--control-mode",
        metavar="MODE",
        help="how the robot is driven (default: auto: pd_ee_delta_pos, shifts of the hand, where the robot has it)",
    )
    parser.add_argument(
        "--steps", type=int, metavar="N", help="of all environments together (default: ppo 50000, sac 30000)"
    )
    parser.add_argument(
        "--envs", type=int, metavar="N", help="environments, a process each (default: the cores, at most 8)"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="of everything that is drawn (default: 0)")
    parser.add_argument(
        "--randomize",
        metavar="WHAT",
        help="none, start, all, or JSON of what differs by how much (default: start)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a hyperparameter; may be given again (--list-settings)",
    )
    parser.add_argument("--list-settings", action="store_true", help="show --algo's hyperparameters and exit")
    parser.add_argument("--device", help="where the network is computed: cpu or cuda (default: cpu)")
    parser.add_argument(
        "--eval-episodes", type=int, metavar="N", help="at the end; 0: do not evaluate (default: 100)"
    )
    parser.add_argument("--no-video", action="store_true", help="do not film the policy at the end")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="the run's folder (default: a new one in $SIMRECON_HOME/runs)"
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the run in --out, or the last of this scene and task",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_common(parser)
    parser.set_defaults(run=run_by_name("simrecon_envs.training.command:run"))
