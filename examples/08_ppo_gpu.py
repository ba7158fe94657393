"""PPO on ManiSkill's GPU simulation: 1024 copies of a scene in one process, all data on the GPU. Needs CUDA.

Episodes continue after success and end together at the step limit, so staying successful pays. `ManiSkillVectorEnv`
resets them. The same seed gives the same actions, but PhysX on a GPU is not deterministic to the last bit.

    python examples/08_ppo_gpu.py --env-id SimRecon/scene0001 --task pick --envs 1024
"""

import argparse
import sys
import time

import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torch import nn

import simrecon_envs

GAMMA, LAMBDA, CLIP, EPOCHS, BATCHES = 0.8, 0.9, 0.2, 4, 32
LEARNING_RATE, MAX_GRAD_NORM, TARGET_KL = 3e-4, 0.5, 0.1


def net(n_in: int, n_out: int, gain: float) -> nn.Sequential:
    """Return a network with three hidden layers."""
    sizes = ((n_in, 256, 2**0.5), (256, 256, 2**0.5), (256, 256, 2**0.5), (256, n_out, gain))
    layers: list[nn.Module] = []
    for a, b, g in sizes:
        layers += [nn.Linear(a, b), nn.Tanh()]
        nn.init.orthogonal_(layers[-2].weight, g)
        nn.init.zeros_(layers[-2].bias)
    return nn.Sequential(*layers[:-1])


class Agent(nn.Module):
    """Gaussian policy and value function."""

    def __init__(self, n_obs: int, n_act: int) -> None:
        """Make networks for observations (n_obs,) and actions (n_act,)."""
        super().__init__()
        self.actor, self.critic = net(n_obs, n_act, 0.01), net(n_obs, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((n_act,), -0.5))

    def policy(self, obs: torch.Tensor) -> torch.distributions.Independent:
        """Return the action distribution for observations (n, k)."""
        return torch.distributions.Independent(
            torch.distributions.Normal(self.actor(obs), self.log_std.exp()), 1
        )

    def value(self, obs: torch.Tensor) -> torch.Tensor:
        """Return the values (n,) of observations (n, k)."""
        return self.critic(obs)[:, 0]


def collect(
    agent: Agent, env: ManiSkillVectorEnv, obs: torch.Tensor, steps: int
) -> tuple[dict, torch.Tensor, list]:
    """Step all environments; return the rollout (t, n, ...), the next observation, metrics of ended episodes."""
    rows: dict[str, list[torch.Tensor]] = {
        key: [] for key in ("obs", "action", "log_prob", "value", "following", "reward", "cut")
    }
    metrics = []
    for _ in range(steps):
        policy = agent.policy(obs)
        action = policy.sample()
        after, reward, _, cut, info = env.step(action.clamp(-1, 1))
        real = info.get("final_observation", after)
        if "final_info" in info:
            metrics.append(
                {k: v[cut].float().mean().item() for k, v in info["final_info"]["episode"].items()}
            )
        parts = (obs, action, policy.log_prob(action), agent.value(obs), agent.value(real), reward, cut)
        for key, part in zip(rows, parts, strict=True):
            rows[key].append(part)
        obs = after
    return {key: torch.stack(parts) for key, parts in rows.items()}, obs, metrics


def advantages(data: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return generalized advantage estimates (t, n); `following` has the values after truncated episodes, too."""
    out, carry = torch.zeros_like(data["reward"]), torch.zeros_like(data["reward"][0])
    for t in reversed(range(len(out))):
        delta = data["reward"][t] + GAMMA * data["following"][t] - data["value"][t]
        carry = out[t] = delta + GAMMA * LAMBDA * carry * ~data["cut"][t]
    return out


def update(agent: Agent, optimizer: torch.optim.Optimizer, data: dict[str, torch.Tensor]) -> None:
    """Update policy and value from a rollout (m, ...)."""
    size = len(data["obs"])
    for _ in range(EPOCHS):
        for rows in torch.randperm(size, device=data["obs"].device).chunk(BATCHES):
            policy = agent.policy(data["obs"][rows])
            log_ratio = policy.log_prob(data["action"][rows]) - data["log_prob"][rows]
            ratio, gain = log_ratio.exp(), data["advantage"][rows]
            if ((ratio - 1) - log_ratio).mean() > TARGET_KL:
                return
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            gain = torch.minimum(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
            error = ((agent.value(data["obs"][rows]) - data["target"][rows]) ** 2).mean()
            optimizer.zero_grad()
            (0.5 * error - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRAD_NORM)
            optimizer.step()


def main() -> None:
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument("--registry", default=None, help="folder of the registry, if not the default")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--task", default="pick", help="a kind of task or a task's name")
    parser.add_argument("--steps", type=int, default=20_000_000, help="of all environments together")
    parser.add_argument("--envs", type=int, default=1024)
    parser.add_argument(
        "--rollout", type=int, default=50, help="steps of each environment between two updates"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=None, help="where to save the weights (.pt)")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        sys.exit(
            f"this example needs CUDA, and torch {torch.__version__} finds none; on the CPU use "
            "`simrecon train` or examples/07_ppo_single_file.py"
        )

    torch.manual_seed(arguments.seed)
    env = ManiSkillVectorEnv(
        simrecon_envs.make(
            arguments.env_id,
            registry=arguments.registry,
            num_envs=arguments.envs,
            task=arguments.task,
            robot_uids=arguments.robot,
            control_mode="pd_joint_delta_pos",
            randomize="start",
            max_episode_steps=100,
        ),
        ignore_terminations=True,
        record_metrics=True,
    )
    agent = Agent(env.single_observation_space.shape[0], env.single_action_space.shape[0]).to(env.device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    obs, _ = env.reset(seed=arguments.seed)
    began, block = time.perf_counter(), arguments.envs * arguments.rollout
    for number in range(max(arguments.steps // block, 1)):
        with torch.no_grad():
            data, obs, metrics = collect(agent, env, obs, arguments.rollout)
            data["advantage"] = advantages(data)
            data["target"] = data["advantage"] + data["value"]
        update(agent, optimizer, {key: part.flatten(0, 1) for key, part in data.items()})
        rate = (number + 1) * block / (time.perf_counter() - began)
        told = (
            "".join(f", {key} {metrics[-1][key]:.2f}" for key in ("success_once", "return"))
            if metrics
            else ""
        )
        print(f"{(number + 1) * block} steps, {rate:.0f} steps/s{told}", flush=True)
    env.close()
    if arguments.out:
        torch.save(agent.state_dict(), arguments.out)


if __name__ == "__main__":
    main()
