"""PPO in one file, in the style of CleanRL: torch and Gymnasium's vector environments.

Shows what `simrecon train` leaves to stable-baselines3. The same seed gives the same policy.

    python examples/07_ppo_single_file.py --env-id SimRecon/scene0001 --task reach
"""

import argparse
import hashlib
import time
from collections import deque

import gymnasium as gym
import numpy as np
import torch
from torch import nn

import simrecon_envs

GAMMA, LAMBDA, CLIP, EPOCHS, BATCH = 0.9, 0.9, 0.2, 10, 100
LEARNING_RATE, MAX_GRAD_NORM, TARGET_KL = 1e-3, 0.5, 0.05
SUCCESS_BONUS = GAMMA / (1 - GAMMA)  # success ends an episode: discounted reward of staying successful
EVALUATION_SEED = 10**9


class Agent(nn.Module):
    """Gaussian policy with state-independent standard deviation, value function, and running normalization."""

    def __init__(self, n_obs: int, n_act: int) -> None:
        """Make networks for observations (n_obs,) and actions (n_act,)."""
        super().__init__()

        def net(n_out: int, gain: float) -> nn.Sequential:
            sizes = ((n_obs, 64, 2**0.5), (64, 64, 2**0.5), (64, n_out, gain))
            layers: list[nn.Module] = []
            for n_in, n, g in sizes:
                layers += [nn.Linear(n_in, n), nn.Tanh()]
                nn.init.orthogonal_(layers[-2].weight, g)
                nn.init.zeros_(layers[-2].bias)
            return nn.Sequential(*layers[:-1])

        self.actor, self.critic = net(n_act, 0.01), net(1, 1.0)
        self.log_std = nn.Parameter(torch.full((n_act,), -1.0))
        self.register_buffer("mean", torch.zeros(n_obs))
        self.register_buffer("var", torch.ones(n_obs))
        self.register_buffer("count", torch.tensor(1e-4))

    def normalize(self, obs: torch.Tensor) -> torch.Tensor:
        """Scale observations (n, k) to mean 0 and standard deviation 1."""
        return ((obs - self.mean) / (self.var + 1e-8).sqrt()).clamp(-10, 10)

    @torch.no_grad()
    def watch(self, obs: torch.Tensor) -> None:
        """Update the running mean and variance with observations (n, k)."""
        n, total = len(obs), self.count + len(obs)
        delta = obs.mean(0) - self.mean
        squares = self.var * self.count + obs.var(0, unbiased=False) * n + delta**2 * self.count * n / total
        self.mean += delta * n / total
        self.var.copy_(squares / total)
        self.count.copy_(total)

    def policy(self, obs: torch.Tensor) -> torch.distributions.Independent:
        """Return the action distribution for normalized observations (n, k)."""
        normal = torch.distributions.Normal(self.actor(obs), self.log_std.exp())
        return torch.distributions.Independent(normal, 1)


def update(agent: Agent, optimizer: torch.optim.Optimizer, data: dict[str, torch.Tensor]) -> None:
    """Update policy and value from one rollout; every tensor has one row per step."""
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(data["obs"])).split(BATCH):
            obs, action, old_log_prob, advantage, target = (
                data[k][rows] for k in ("obs", "action", "log_prob", "advantage", "target")
            )
            policy = agent.policy(obs)
            log_ratio = policy.log_prob(action) - old_log_prob
            ratio = log_ratio.exp()
            if ((ratio - 1) - log_ratio).mean() > 1.5 * TARGET_KL:
                return
            advantage = (advantage - advantage.mean()) / (advantage.std(unbiased=False) + 1e-8)
            gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
            error = ((agent.critic(obs)[:, 0] - target) ** 2).mean()
            optimizer.zero_grad()
            (0.5 * error - gain).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), MAX_GRAD_NORM)
            optimizer.step()


def advantages(
    reward: torch.Tensor, value: torch.Tensor, last: torch.Tensor, ended: torch.Tensor, cut: torch.Tensor
) -> torch.Tensor:
    """Return generalized advantage estimates (t, n) for t steps of n environments.

    Args:
        reward: Rewards (t, n).
        value: Values of the observations (t, n).
        last: Value of the observation after the last step (n,).
        ended: The episode terminated with success (t, n); the next value is 0.
        cut: The episode was truncated by the step limit (t, n); the next value counts.
    """
    out, carry = torch.zeros_like(reward), torch.zeros_like(last)
    # Gymnasium returns an episode's last observation before the next episode's first one.
    following = torch.cat([value[1:], last[None]])
    for t in reversed(range(len(reward))):
        delta = reward[t] + GAMMA * following[t] * ~ended[t] - value[t]
        carry = out[t] = delta + GAMMA * LAMBDA * carry * ~(ended[t] | cut[t])
    return out


def evaluate(agent: Agent, env: gym.Env, episodes: int) -> int:
    """Return the number of successes of the deterministic policy, on seeds that training did not use."""
    successes = 0
    for seed in range(EVALUATION_SEED, EVALUATION_SEED + episodes):
        obs, _ = env.reset(seed=seed)
        done = False
        while not done:
            with torch.no_grad():
                action = agent.actor(agent.normalize(torch.as_tensor(obs)[None]))[0].numpy()
            obs, _, terminated, truncated, info = env.step(action.clip(-1, 1))
            done = terminated or truncated
        successes += bool(info["success"])
    return successes


def train(agent: Agent, envs: gym.vector.VectorEnv, steps: int, rollout: int, seed: int) -> None:
    """Train for about `steps` steps with an update every `rollout` steps, both summed over environments."""
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    n, began, recent = envs.num_envs, time.perf_counter(), deque(maxlen=100)
    obs, _ = envs.reset(seed=seed)
    obs = torch.as_tensor(obs)
    over = torch.zeros(n, dtype=torch.bool)  # the previous step ended an episode; this one is a reset
    for number in range(max(steps // rollout, 1)):
        rows: dict[str, list[torch.Tensor]] = {
            key: [] for key in ("obs", "action", "log_prob", "value", "reward", "ended", "cut", "real")
        }
        for _ in range(max(rollout // n, 2)):
            agent.watch(obs)
            with torch.no_grad():
                seen = agent.normalize(obs)
                policy, value = agent.policy(seen), agent.critic(seen)[:, 0]
                action = policy.sample()
            after, reward, terminated, truncated, info = envs.step(action.numpy().clip(-1, 1))
            ended, cut = torch.as_tensor(terminated), torch.as_tensor(truncated)
            won = torch.as_tensor(np.asarray(info.get("success", np.zeros(n)), bool)) & ended
            reward = torch.as_tensor(reward, dtype=torch.float32) + SUCCESS_BONUS * won
            parts = (
                seen,
                action,
                policy.log_prob(action),
                value,
                reward * (1 - GAMMA),
                ended,
                cut | over,
                ~over,
            )
            for key, part in zip(rows, parts, strict=True):
                rows[key].append(part)
            recent += won[ended | cut].tolist()
            obs, over = torch.as_tensor(after), ended | cut
        data = {key: torch.stack(parts) for key, parts in rows.items()}
        with torch.no_grad():
            last = agent.critic(agent.normalize(obs))[:, 0]
        data["advantage"] = advantages(data["reward"], data["value"], last, data["ended"], data["cut"])
        data["target"] = data["advantage"] + data["value"]
        update(
            agent, optimizer, {key: part.flatten(0, 1)[data["real"].flatten()] for key, part in data.items()}
        )
        rate = (number + 1) * rollout / (time.perf_counter() - began)
        success = f"{np.mean(recent):.0%}" if recent else "?"
        print(f"{(number + 1) * rollout} steps, {rate:.0f} steps/s, success {success}", flush=True)


def main() -> None:
    """Train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env-id", default="SimRecon/scene0001")
    parser.add_argument("--registry", default=None, help="folder of the registry, if not the default")
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--task", default="reach", help="a kind of task or a task's name")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--rollout", type=int, default=1000, help="steps between two updates")
    parser.add_argument("--envs", type=int, default=2, help="environments in parallel, one process each")
    parser.add_argument("--episodes", type=int, default=50, help="to evaluate with")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default=None, help="where to save the weights (.pt)")
    arguments = parser.parse_args()

    torch.manual_seed(arguments.seed)
    torch.set_num_threads(1)
    made = {
        "registry": arguments.registry, "task": arguments.task, "robot_uids": arguments.robot,
        "control_mode": "pd_ee_delta_pos", "observe_objects": False, "randomize": "start", "max_episode_steps": 100,
    }  # fmt: skip
    kind = "async" if arguments.envs > 1 else "sync"
    envs = simrecon_envs.make_vec(arguments.env_id, arguments.envs, kind=kind, **made)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    train(agent, envs, arguments.steps, min(arguments.rollout, arguments.steps), arguments.seed)
    envs.close()
    env = simrecon_envs.make_cpu(arguments.env_id, **made)
    successes = evaluate(agent, env, arguments.episodes)
    env.close()
    weights = b"".join(value.numpy().tobytes() for value in agent.state_dict().values())
    print(f"policy {hashlib.sha256(weights).hexdigest()[:16]}")
    print(f"success: {successes} of {arguments.episodes} episodes")
    if arguments.out:
        torch.save(agent.state_dict(), arguments.out)


if __name__ == "__main__":
    main()
