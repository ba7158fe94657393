"""`simrecon train`: trains a policy for a task in a scene by reinforcement learning."""

import argparse
from pathlib import Path

from reconstruction.commands.environments import run_by_name
from reconstruction.commands.options import SEEDS, add_common, add_verb, whole_number

_DESCRIPTION = """Train a policy for a task in SCENE by reinforcement learning (stable-baselines3), on the CPU, with one
process for each environment. The trained policy is evaluated on unseen seeds and recorded on video. One folder holds
the settings, checkpoints, TensorBoard curves, results.json and video.mp4."""

_EPILOG = """what to know:
  tasks        `simrecon show SCENE` and simrecon_envs.list_tasks list them; reach takes a few minutes, pick and tasks
               that contain it some millions of steps
  start        every episode starts differently (--randomize start): objects shifted by up to 5 cm and rotated, joints
               of the arm by up to 0.05 rad, seeded by --seed. The same --seed and --envs give the same policy
  interrupt    Ctrl-C finishes the update and writes a checkpoint; after a kill, the last checkpoint is at most a
               minute old. --resume continues from it, to the same number of steps
  curves       tensorboard --logdir ~/.simrecon/runs
  afterwards   simrecon_envs.training.load_policy(FOLDER) is the policy: observation -> action

examples:
  simrecon train scene0001 --task reach
  simrecon train scene0001 --task push_tray --algo sac --steps 100000 --seed 3
  simrecon train scene0001 --task reach --set learning_rate=3e-4 --set net_arch=128,128
  simrecon train scene0001 --resume                      the last run of this scene, task and algorithm
  simrecon train scene0001 --resume --out FOLDER --steps 300000       with more steps
  simrecon train --algo sac --list-settings
"""


def add_parser(verbs: argparse._SubParsersAction) -> None:
    """Add the verb."""
    parser = add_verb(verbs, "train", "train a policy for a task in a scene", _DESCRIPTION, _EPILOG)
    add = parser.add_argument
    add("scene", metavar="SCENE", nargs="?", help="a scene id, for example scene0001")
    add("--task", default="reach", help="kind (reach, pick ...) or name of a task (default: reach)")
    add("--algo", default="ppo", choices=("ppo", "sac"), help="default: ppo")
    add("--robot", help="robot of ManiSkill (default: panda)")
    add("--obs-mode", choices=("state", "rgb"), help="observations (default: state)")
    add(
        "--control-mode",
        metavar="MODE",
        help="controller of the robot (default: auto: pd_ee_delta_pos, displacements of the hand, if available)",
    )
    add(
        "--steps",
        type=whole_number(1, 10**12),
        metavar="N",
        help="steps of all environments (default: ppo 50000, sac 30000)",
    )
    add(
        "--envs",
        type=whole_number(1, 10_000),
        metavar="N",
        help="environments, one process each (default: cores, at most 8)",
    )
    add("--seed", type=whole_number(*SEEDS), metavar="N", help="seed of all random numbers (default: 0)")
    add(
        "--randomize",
        metavar="WHAT",
        help="randomization of episodes: none, start, all, or JSON (docs/environments.md; default: start)",
    )
    add("--set", action="append", default=[], metavar="NAME=VALUE", help="hyperparameter; may be repeated")
    add("--list-settings", action="store_true", help="show --algo's hyperparameters and exit")
    add("--device", help="device of the network: cpu or cuda (default: cpu)")
    add(
        "--eval-episodes",
        type=whole_number(0),
        metavar="N",
        help="episodes of the evaluation; 0: none (default: 100)",
    )
    add("--no-video", action="store_true", help="do not record a video of the policy")
    add("--out", type=Path, metavar="DIR", help="folder of the run (default: new in $SIMRECON_HOME/runs)")
    add("--resume", action="store_true", help="continue the run in --out, or the last of this task")
    add("--quiet", action="store_true", help="no progress")
    add_common(parser)
    parser.set_defaults(run=run_by_name("simrecon_envs.training.command:run"))
