"""Times one DrQ-v2 update at the paper's sizes in PyTorch, for comparison.

    python -m venv torch-env && torch-env/bin/pip install torch==2.13.0 numpy
    torch-env/bin/python launch/results/torch_update.py [REPEATS]

Written as PyTorch users write DrQ-v2: modules, autograd, one Adam for each of encoder,
actor and critic, bilinear sampling for the random shift. Random data, 6 action
dimensions, batch 256, 84x84 pixels. Nothing else here needs PyTorch.
"""

import statistics
import sys
import time

import torch
from torch import Tensor, nn
from torch.nn import functional

BATCH, ACTIONS, FEATURES, HIDDEN, STD, CLIP, PADDING = 256, 6, 50, 1024, 0.5, 0.3, 4


def shift(images: Tensor) -> Tensor:
    """Moves images [B, C, S, S] by up to four pixels, edges repeated."""
    batch, _, size, _ = images.shape
    padded_size = size + 2 * PADDING
    padded = functional.pad(images, (PADDING,) * 4, "replicate")
    end = 1 - 1 / padded_size
    centres = torch.linspace(-end, end, padded_size)[:size]
    rows, columns = torch.meshgrid(centres, centres, indexing="ij")
    grid = torch.stack([columns, rows], -1).expand(batch, size, size, 2)
    moves = torch.randint(0, 2 * PADDING + 1, (batch, 1, 1, 2)) * 2.0 / padded_size
    return functional.grid_sample(
        padded, grid + moves, padding_mode="zeros", align_corners=False
    )


def make_encoder() -> nn.Sequential:
    """Four convolutions of 32 channels: 39200 numbers of an 84x84 observation."""
    layers: list[nn.Module] = []
    for channels, stride in ((9, 2), (32, 1), (32, 1), (32, 1)):
        layers += [nn.Conv2d(channels, 32, 3, stride=stride), nn.ReLU()]
    return nn.Sequential(*layers, nn.Flatten())


def make_trunk() -> nn.Sequential:
    return nn.Sequential(nn.Linear(39200, FEATURES), nn.LayerNorm(FEATURES), nn.Tanh())


def make_mlp(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(
        *(nn.Linear(inputs, HIDDEN), nn.ReLU(inplace=True)),
        *(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(inplace=True)),
        nn.Linear(HIDDEN, outputs),
    )


def sample_action(actor: nn.Module, representation: Tensor) -> Tensor:
    mean = torch.tanh(actor(representation))
    action = mean + (torch.randn_like(mean) * STD).clamp(-CLIP, CLIP)
    clamped = action.clamp(-1 + 1e-6, 1 - 1e-6)
    return action - action.detach() + clamped.detach()


class Critic(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.trunk = make_trunk()
        self.heads = nn.ModuleList([make_mlp(FEATURES + ACTIONS, 1) for _ in range(2)])

    def forward(self, representation: Tensor, action: Tensor) -> list[Tensor]:
        inputs = torch.cat([self.trunk(representation), action], -1)
        return [head(inputs) for head in self.heads]


class Learner:
    def __init__(self) -> None:
        self.encoder = make_encoder()
        self.actor = nn.Sequential(make_trunk(), make_mlp(FEATURES, ACTIONS))
        self.critic, self.target = Critic(), Critic()
        self.target.load_state_dict(self.critic.state_dict())
        networks = (self.encoder, self.actor, self.critic)
        self.optimisers = [torch.optim.Adam(n.parameters(), 1e-4) for n in networks]

    def encode(self, pixels: Tensor) -> Tensor:
        return self.encoder(shift(pixels.float()) / 255.0 - 0.5)

    def update(
        self,
        observation: Tensor,
        action: Tensor,
        reward: Tensor,
        discount: Tensor,
        next_observation: Tensor,
    ) -> None:
        """Learns from one batch, in the order of DrQ-v2."""
        encoder_step, actor_step, critic_step = self.optimisers
        representation = self.encode(observation)
        with torch.no_grad():
            following = self.encode(next_observation)
            values = self.target(following, sample_action(self.actor, following))
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
        values = self.critic(representation, sample_action(self.actor, representation))
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
    learner, times = Learner(), []
    images = torch.randint(0, 256, (2, BATCH, 9, 84, 84), dtype=torch.uint8)
    numbers = torch.rand(2, BATCH, 1)
    action = torch.rand(BATCH, ACTIONS) * 2 - 1
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        learner.update(images[0], action, *numbers, images[1])
        times.append(1e3 * (time.perf_counter() - begin))
    times = times[1:]  # the first one is for warming up
    print(
        f"PyTorch {torch.__version__}, {torch.get_num_threads()} threads, {repeats} "
        f"updates: median {statistics.median(times):.0f} ms, lowest {min(times):.0f} "
        f"ms, highest {max(times):.0f} ms"
    )


if __name__ == "__main__":
    main()
