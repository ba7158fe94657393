"""Train a network of the depth stage on a dataset of rooms, and export its weights.

    python -m priors.train CONFIG.yaml [--resume]

Stop it at any time: `--resume` (or the same command again) goes on from the last checkpoint with the same samples as
if it had not been stopped. On a CPU all is float32; where there is CUDA, bfloat16 under autocast. Curves:
`tensorboard --logdir OUT`. The weights that are best on the held-out splits go to `OUT/best.safetensors`.
"""

import argparse
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
import torch
import yaml

from priors import aggregation, mending
from priors.samples import Room, open_rooms

NETWORKS = {"aggregation": aggregation, "mending": mending}
"""Modules with the samples, loss and figures of each network that can be trained."""


@dataclass(frozen=True)
class TrainConfig:
    """What is trained, on what, for how long."""

    network: str
    data: str
    out: str
    start: str = ""  # weights of the same network to begin with; "" = random ones
    steps: int = 4000
    minutes: float = 0.0  # > 0: the learning rate falls with this time, and training ends then or at `steps`
    batch: int = 8
    rate: float = 2e-3
    decay: float = 1e-4
    warm_up: int = 150
    ema: float = 0.998
    seed: int = 0
    threads: int = 0
    widths: tuple[int, ...] = ()  # channels at a half, a quarter, ... of the resolution; () = the usual ones
    border_weight: float = 3.0  # of the aggregation network alone
    affinity_weight: float = 0.2
    check_every: int = 400
    save_every: int = 50
    check_keyframes: int = 48
    held_out: tuple[str, ...] = ("shapes", "rooms")
    refresh_every: int = 200  # steps between looks for rooms that were finished meanwhile
    compiled: bool = False  # where there is CUDA: the loss by torch.compile, which takes a minute first


def main(arguments: list[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m priors.train", description=__doc__.split("\n\n")[0])
    parser.add_argument("config", type=Path, help="YAML with the fields of TrainConfig")
    parser.add_argument(
        "--resume", action="store_true", help="say so where a checkpoint is expected to be there"
    )
    options = parser.parse_args(arguments)
    values = yaml.safe_load(options.config.read_text())
    unknown = set(values) - {f.name for f in fields(TrainConfig)}
    if unknown:
        parser.error(f"{options.config}: unknown fields {sorted(unknown)}")
    if values.get("network") not in NETWORKS:
        parser.error(f"{options.config}: network must be one of {', '.join(NETWORKS)}")
    train(TrainConfig(**values), must_resume=options.resume)
    return 0


def draw_batch(task, rooms: list[Room], config: TrainConfig, step: int) -> list[torch.Tensor]:
    """Draw the samples of a step; the same ones whenever it is asked for."""
    rng = np.random.default_rng((config.seed, step))
    return task.stack(
        [task.draw_sample(rooms[int(rng.integers(len(rooms)))], rng) for _ in range(config.batch)]
    )


def rate_at(step: int, config: TrainConfig, seconds: float = 0.0) -> float:
    """Return the learning rate: a linear start, then half a cosine down to zero, over steps or over time."""
    if step < config.warm_up:
        return config.rate * (step + 1) / config.warm_up
    share = (step - config.warm_up) / max(1, config.steps - config.warm_up)
    if config.minutes > 0:
        share = seconds / (60 * config.minutes)
    return float(config.rate * 0.5 * (1 + np.cos(np.pi * min(share, 1.0))))


def train(config: TrainConfig, must_resume: bool = False) -> None:
    """Train until `steps`, from the checkpoint if there is one."""
    from safetensors.torch import load_file, save_file
    from torch.utils.tensorboard import SummaryWriter

    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    if config.threads:
        torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    task = NETWORKS[config.network]
    torch.backends.cudnn.benchmark = device == "cuda"  # all crops have one size
    net = task.make_network(config).to(device)
    if config.start:
        weights = load_file(config.start)
        net.load_state_dict({name: value.to(net.state_dict()[name].dtype) for name, value in weights.items()})
    slow = task.make_network(config).to(device)
    slow.load_state_dict(net.state_dict())
    averaged, current = (
        [value for value in model.state_dict().values() if value.dtype.is_floating_point]
        for model in (slow, net)
    )
    optimizer = torch.optim.AdamW(net.parameters(), lr=config.rate, weight_decay=config.decay)
    first, best = 0, float("inf")
    checkpoint = out / "checkpoint.pt"
    if checkpoint.is_file():
        state = torch.load(checkpoint, weights_only=True, map_location=device)
        net.load_state_dict(state["net"])
        slow.load_state_dict(state["slow"])
        optimizer.load_state_dict(state["optimizer"])
        first, best = state["step"], state["best"]
    elif must_resume:
        raise SystemExit(f"{checkpoint}: there is no checkpoint to resume from")
    data = Path(config.data)
    (out / "config.json").write_text(json.dumps(asdict(config), indent=1) + "\n")
    log = SummaryWriter(str(out), purge_step=first)
    rooms: list[Room] = []
    held: dict[str, list[Room]] = {}
    started, seen = time.perf_counter(), 0
    ahead, coming = ThreadPoolExecutor(1), None
    pool = task.POOL(device) if device == "cuda" else None
    losses = torch.compile(task.losses) if config.compiled and device == "cuda" else task.losses
    for step in range(first, config.steps):
        if not rooms or step % config.refresh_every == 0:
            rooms = open_rooms(data / "train", task.ARRAYS)
            held = {name: open_rooms(data / name, task.ARRAYS) for name in config.held_out}
            if pool is not None and not len(pool):
                pool.add(rooms)
            elif pool is not None:  # read beside the next steps
                if coming is not None:
                    pool.take(coming.result())
                coming = ahead.submit(pool.read, rooms)
        seconds = time.perf_counter() - started
        last = step + 1 == config.steps or 0 < 60 * config.minutes <= seconds
        for group in optimizer.param_groups:
            group["lr"] = rate_at(step, config, seconds)
        if pool is not None:
            batch = pool.draw(config.batch, torch.Generator().manual_seed(config.seed * 1_000_003 + step))
        else:
            # The next samples are drawn while this step is computed, but for those that may come from newer rooms.
            coming = coming or ahead.submit(draw_batch, task, rooms, config, step)
            batch = coming.result()
            fresh = (step + 1) % config.refresh_every == 0 or last
            coming = None if fresh else ahead.submit(draw_batch, task, rooms, config, step + 1)
        net.train()
        torch.manual_seed(config.seed * 1_000_003 + step)  # of dropout
        with torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            parts = losses(net, batch, config)
        total = sum(parts.values())
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 2.0)
        optimizer.step()
        keep = min(config.ema, (step + 1) / (step + 10))
        with torch.no_grad():
            torch._foreach_lerp_(averaged, current, 1 - keep)
            for a, b in zip(slow.buffers(), net.buffers(), strict=True):
                if not a.dtype.is_floating_point:
                    a.copy_(b)
        seen += config.batch
        if device == "cpu" or (step + 1) % 50 == 0:  # reading a value waits for the device
            for name, value in parts.items():
                log.add_scalar(f"train/{name}", value.item(), step)
        if (step + 1) % 50 == 0:
            speed = seen / (time.perf_counter() - started)
            told = ", ".join(f"{n} {v.item():.3f}" for n, v in parts.items())
            print(f"step {step + 1}: {told}; {speed:.2f} crops/s, {len(rooms)} rooms", flush=True)
        if (step + 1) % config.check_every == 0 or last:
            slow.eval()
            figures = {}
            for name, split in [("train", rooms[-60:]), *held.items()]:
                if split:
                    figures[name] = task.check(slow, split, config.check_keyframes)
                    for key, value in figures[name].items():
                        log.add_scalar(f"{name}/{key}", value, step)
            shown = {n: {k: round(v, 4) for k, v in f.items()} for n, f in figures.items()}
            print(f"step {step + 1}: {json.dumps(shown)}", flush=True)
            with (out / "curve.jsonl").open("a") as file:
                file.write(
                    json.dumps({"step": step + 1, "seconds": time.perf_counter() - started, **figures}) + "\n"
                )
            score = np.mean(
                [figures[n][task.SCORE] for n in figures if n != "train"] or [figures["train"][task.SCORE]]
            )
            if score < best:
                best = float(score)
                weights = {
                    k: v.half().contiguous() if v.dtype == torch.float32 else v
                    for k, v in slow.state_dict().items()
                }
                about = {
                    "config": json.dumps(asdict(config)),
                    "step": str(step + 1),
                    "figures": json.dumps(figures),
                }
                save_file(weights, str(out / "best.safetensors"), metadata=about)
        if (step + 1) % config.save_every == 0 or (step + 1) % config.check_every == 0 or last:
            state = {
                "net": net.state_dict(), "slow": slow.state_dict(), "optimizer": optimizer.state_dict(),
                "step": step + 1, "best": best,
            }  # fmt: skip
            torch.save(state, checkpoint.with_suffix(".part"))
            checkpoint.with_suffix(".part").replace(checkpoint)
        if last:
            break
    ahead.shutdown()
    log.close()


if __name__ == "__main__":
    sys.exit(main())
