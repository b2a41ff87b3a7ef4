"""Times one DrQ-v2 update at the paper's sizes in PyTorch, to compare with.

    python -m venv torch-env && torch-env/bin/pip install torch==2.13.0 numpy
    torch-env/bin/python launch/results/torch_update.py [REPEATS]

Written as PyTorch users write DrQ-v2: modules, autograd, one Adam for each of encoder,
actor and critic, bilinear sampling for the random shift. Random data, 6 action
dimensions, batch 256, 84x84 pixels. PyTorch is not needed for anything else here.
"""

import statistics
import sys
import time

import torch
from torch import nn
from torch.nn import functional

BATCH, ACTIONS, FEATURES, HIDDEN, STD, CLIP, PADDING = 256, 6, 50, 1024, 0.5, 0.3, 4


def shift(images: torch.Tensor) -> torch.Tensor:
    """Returns images [B, C, S, S] moved by up to four pixels, edges repeated."""
    batch, _, size, _ = images.shape
    padded_size = size + 2 * PADDING
    padded = functional.pad(images, (PADDING,) * 4, "replicate")
    centres = torch.linspace(
        -1 + 1 / padded_size, 1 - 1 / padded_size, padded_size, device=images.device
    )[:size]
    rows, columns = torch.meshgrid(centres, centres, indexing="ij")
    grid = torch.stack([columns, rows], -1).expand(batch, size, size, 2)
    moves = torch.randint(0, 2 * PADDING + 1, (batch, 1, 1, 2)) * 2.0 / padded_size
    return functional.grid_sample(
        padded, grid + moves, padding_mode="zeros", align_corners=False
    )


class Encoder(nn.Module):
    """Four convolutions of 32 channels: 39200 numbers of an 84x84 observation."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels, stride in ((9, 2), (32, 1), (32, 1), (32, 1)):
            layers += [nn.Conv2d(channels, 32, 3, stride=stride), nn.ReLU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.layers(images / 255.0 - 0.5).flatten(1)


def trunk() -> nn.Sequential:
    """Returns the squeeze to 50 features that actor and critic each have."""
    return nn.Sequential(nn.Linear(39200, FEATURES), nn.LayerNorm(FEATURES), nn.Tanh())


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    """Returns two hidden layers of 1024."""
    return nn.Sequential(
        *(nn.Linear(inputs, HIDDEN), nn.ReLU(inplace=True)),
        *(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(inplace=True)),
        nn.Linear(HIDDEN, outputs),
    )


class Actor(nn.Module):
    """Means of actions in [-1, 1]."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk, self.policy = trunk(), mlp(FEATURES, ACTIONS)

    def forward(self, representation: torch.Tensor) -> torch.Tensor:
        mean = torch.tanh(self.policy(self.trunk(representation)))
        noise = (torch.randn_like(mean) * STD).clamp(-CLIP, CLIP)
        action = mean + noise
        clamped = action.clamp(-1 + 1e-6, 1 - 1e-6)
        return action - action.detach() + clamped.detach()


class Critic(nn.Module):
    """Two values of an observation and an action."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = trunk()
        self.heads = nn.ModuleList([mlp(FEATURES + ACTIONS, 1) for _ in range(2)])

    def forward(
        self, representation: torch.Tensor, action: torch.Tensor
    ) -> list[torch.Tensor]:
        inputs = torch.cat([self.trunk(representation), action], -1)
        return [head(inputs) for head in self.heads]


class Learner:
    """The three networks, the target and their optimisers."""

    def __init__(self) -> None:
        self.encoder, self.actor = Encoder(), Actor()
        self.critic, self.target = Critic(), Critic()
        self.target.load_state_dict(self.critic.state_dict())
        networks = (self.encoder, self.actor, self.critic)
        self.optimisers = [torch.optim.Adam(n.parameters(), 1e-4) for n in networks]

    def update(
        self,
        observation: torch.Tensor,
        action: torch.Tensor,
        reward: torch.Tensor,
        discount: torch.Tensor,
        next_observation: torch.Tensor,
    ) -> None:
        """Learns from one batch, in the order of DrQ-v2."""
        encoder_step, actor_step, critic_step = self.optimisers
        representation = self.encoder(shift(observation.float()))
        with torch.no_grad():
            following = self.encoder(shift(next_observation.float()))
            values = self.target(following, self.actor(following))
            goal = reward + discount * torch.minimum(*values)
        loss = sum(
            functional.mse_loss(value, goal)
            for value in self.critic(representation, action)
        )
        encoder_step.zero_grad(set_to_none=True)
        critic_step.zero_grad(set_to_none=True)
        loss.backward()
        critic_step.step()
        encoder_step.step()

        representation = representation.detach()
        values = self.critic(representation, self.actor(representation))
        actor_step.zero_grad(set_to_none=True)
        (-torch.minimum(*values).mean()).backward()
        actor_step.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.critic.parameters(), strict=True)
            for old, new in pairs:
                old.lerp_(new, 0.01)


def main() -> None:
    """Prints the milliseconds of an update: median, lowest, highest."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    learner = Learner()
    images = torch.randint(0, 256, (2, BATCH, 9, 84, 84), dtype=torch.uint8)
    numbers = torch.rand(2, BATCH, 1)
    action = torch.rand(BATCH, ACTIONS) * 2 - 1
    times = []
    for repeat in range(repeats + 1):
        begin = time.perf_counter()
        learner.update(images[0], action, numbers[0], numbers[1], images[1])
        if repeat:  # the first one is for warming up
            times.append(1e3 * (time.perf_counter() - begin))
    threads = torch.get_num_threads()
    print(
        f"PyTorch {torch.__version__}, {threads} threads, {repeats} updates: "
        f"median {statistics.median(times):.0f} ms, lowest {min(times):.0f} ms, "
        f"highest {max(times):.0f} ms"
    )


if __name__ == "__main__":
    main()
