"""How well linear attention can learn RepeatPreviousEasy at all: the agents of popgym-rs in plain PyTorch, told the right answer.

No reinforcement learning and none of popgym-rs's own code: at every step the network is told which suit it should have
named (cross-entropy, Adam with `quick`'s learning rate and clipping, every episode used once). What it does not learn here,
no actor-critic can be expected to learn from rewards. Needs torch; `fast_weights.py` prints the table of fast_weights.md.
"""

import argparse
import pathlib
import sys

import torch
import torch.nn.functional as F
from torch import nn

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "models" / "benches"))
from eager import KINDS, Fart, Fwp  # noqa: E402

SUITS, CARDS, BACK = 4, 52, 3
FEATURES = {"relu": torch.relu, "elu": lambda x: F.elu(x) + 1}


class Sums(Fwp):
    """FWP with another feature map of keys and queries, or with sums divided as attention's are."""

    def __init__(self, features, divided):
        super().__init__()
        self.features, self.divided = FEATURES[features], divided

    def forward(self, x):
        x = self.norm(x)
        k, q = (self.features(layer(x)) for layer in (self.key, self.query))
        k, q = (a / (1e-5 + a.sum(-1, keepdim=True)) for a in (k, q))
        weights = (q @ k.transpose(1, 2)).tril()
        if self.divided:
            weights = weights / (weights.sum(-1, keepdim=True) + 1e-5)
        return self.tail(weights @ self.value(x), x)


MEMORIES = {
    "gru": (KINDS["gru"], False),
    "fart": (Fart, True),
    "fwp": (Fwp, True),
    "fwp, divided": (lambda: Sums("relu", True), True),
    "fwp, ELU + 1": (lambda: Sums("elu", False), True),
    "fwp, ELU + 1, divided": (lambda: Sums("elu", True), True),
}


class Agent(nn.Module):
    """POPGym's outer model around a memory, without the critic."""

    def __init__(self, memory, positional):
        super().__init__()
        self.projection, self.preprocessor, self.memory = nn.Linear(SUITS, 128), nn.Linear(128, 128), memory
        self.actor = nn.Sequential(
            nn.Linear(256, 128), nn.LeakyReLU(), nn.Linear(128, 128), nn.LeakyReLU(), nn.Linear(128, SUITS))
        for layer in (self.projection, self.preprocessor, self.actor[0], self.actor[2]):
            nn.init.orthogonal_(layer.weight)
        nn.init.normal_(self.actor[4].weight, std=0.01)
        self.scale = nn.Parameter(torch.tensor(0.5)) if positional else None
        angles = torch.arange(CARDS)[:, None] * 1024.0 ** (-torch.arange(64) / 64)
        self.encoding = torch.stack([angles.sin(), angles.cos()], -1).flatten(1)

    def forward(self, x):
        u = F.layer_norm(self.projection(x), (128,))
        if self.scale is not None:
            scale = self.scale.clamp(0, 1)
            u = (1 - scale) * u + scale * self.encoding
        return self.actor(self.memory(F.leaky_relu(self.preprocessor(u))))


def returns(memory, seed, marks, episodes=20):
    """Mean episodic returns of the greedy policy, at so many environment steps: over the updates of the 5% before each."""
    torch.manual_seed(seed)
    make, positional = MEMORIES[memory]
    agent = Agent(make(), positional)
    optimiser = torch.optim.Adam(agent.parameters(), 7e-4, eps=1e-8)
    deck = torch.arange(CARDS) % SUITS
    recent, steps, found = [], 0, []
    for mark in marks:
        while steps < mark:
            suits = torch.stack([deck[torch.randperm(CARDS)] for _ in range(episodes)])
            logits, answer = agent(F.one_hot(suits, SUITS).float())[:, BACK:], suits[:, :-BACK]
            optimiser.zero_grad()
            F.cross_entropy(logits.flatten(0, 1), answer.flatten()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()
            steps += suits.numel()
            recent.append((logits.argmax(-1) == answer).float().mean().item())
        last = recent[-max(1, len(recent) // 20):]
        found.append(2 * sum(last) / len(last) - 1)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--memories", nargs="+", choices=MEMORIES, default=list(MEMORIES), metavar="NAME")
    parser.add_argument("--steps", type=float, nargs="+", default=[0.5e6, 1.5e6])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print("| memory | seed |" + "".join(f" {mark / 1e6:g}M steps |" for mark in arguments.steps))
    print("|---|--:|" + "--:|" * len(arguments.steps))
    for memory in arguments.memories:
        for seed in range(arguments.seeds):
            row = "".join(f" {value:.3f} |" for value in returns(memory, seed, arguments.steps))
            print(f"| {memory} | {seed} |{row}", flush=True)


if __name__ == "__main__":
    main()
