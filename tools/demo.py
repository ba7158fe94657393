"""Reconstruct the shipped video, roll a robot out in it, and print what to type next. Run by `make demo`.

Everything is cached: a second run takes seconds.
"""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SCENE = "demo_room"
OUT = ROOT / "demo"


def main() -> int:
    """Run the main job on the demo video."""
    video = ROOT / "examples" / "data" / "demo_room.mp4"
    done = subprocess.run(
        [sys.executable, "-m", "reconstruction.cli", "reconstruct", str(video), "--scene", SCENE], cwd=ROOT
    )
    if done.returncode:
        return done.returncode
    sys.path.insert(0, str(ROOT))
    from registry import SceneRegistry
    from registry.errors import EnvironmentMissing
    from simrecon_envs.rollout import record_rollout, render_scene_picture

    record = SceneRegistry().get(SCENE)
    OUT.mkdir(exist_ok=True)
    rollout, picture = OUT / f"{SCENE}-{record.revision}.mp4", OUT / f"{SCENE}-{record.revision}.png"
    env_id = f"SimRecon/{SCENE}"
    try:
        if not picture.exists():
            render_scene_picture(env_id, picture)
        if not rollout.exists():
            print("recording a rollout (a minute without a GPU) ...", flush=True)
            record_rollout(env_id, rollout, steps=90, seed=0)
    except EnvironmentMissing as error:
        print(f"no rollout video on this machine: {error}")
        picture = Path(record.path) / "preview.png"
        rollout = None
    python = Path(sys.executable)
    command = python.relative_to(ROOT) if python.is_relative_to(ROOT) else python
    print(f"\nregistered id:  {env_id}")
    print(f"picture:        {picture}")
    if rollout:
        print(f"rollout video:  {rollout}")
    print("\ntype next:")
    print(f"  {command} examples/04_random_policy.py --env-id {env_id}")
    print(f"  {command} -m reconstruction.cli reconstruct YOUR_VIDEO.mp4 --scene my_room")
    print(f"  {command} -m reconstruction.cli show {SCENE}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
