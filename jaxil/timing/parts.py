"""The parts of an update, each compiled alone, so that each can be timed.

XLA fuses the real update: it shares and overlaps work across these borders, so the
parts need not sum up to it.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import Array

from jaxil.learner.rewarder import AgentView, Rewarder
from jaxil.learner.state import TrainState, apply_gradients
from jaxil.maths import augmentation, distributions, losses
from jaxil.maths.types import Batch, Data, ExpertBatch, Params
from jaxil.networks.agent import AgentNetworks, apply

_STD = 0.1  # of exploration; its value costs nothing


def make_parts(
    networks: AgentNetworks,
    rewarder: Rewarder,
    state: TrainState,
    batch: Batch | None,
    expert: ExpertBatch | None,
    *,
    learning_rate: float,
    critic_target_tau: float,
    noise_clip: float,
    shift_padding: int,
) -> dict[str, Callable[[], Any]]:
    """Returns a function for each part of the update that the method has.

    Args:
      networks: of the agent.
      rewarder: the imitation method.
      state: of the learner; it is read and copied, not donated.
      batch: on the device; None for behavioural cloning.
      expert: on the device; None where the method samples none.
      learning_rate: as the next three, see `learner.update.Learner`.
      critic_target_tau: see there.
      noise_clip: see there.
      shift_padding: see there.

    Returns:
      "encoder": shifts, encodes and goes back to the encoder's weights; "critic" and
      "actor": the same on representations; "rewarder": the method's own step;
      "optimiser": Adam on all networks, and the target critic.
    """
    encoder, actor, critic = networks
    seen = expert if batch is None else batch
    assert seen is not None
    params, key = state.params, jax.random.key(0)

    def augment(observation: Data) -> Array:
        return augmentation.augment(observation, key, padding=shift_padding)

    def see(params: Params, observation: Data) -> Array:
        return apply(encoder, params, augment(observation))

    def explore(params: Params, representation: Array) -> Array:
        mean = jnp.tanh(apply(actor, params, representation))
        return distributions.sample_truncated_normal(
            mean, jnp.float32(_STD), key, noise_clip=noise_clip
        )

    @jax.jit
    def run_encoder(params: Params, seen: Any, cotangent: Array) -> Any:
        _, pull_back = jax.vjp(lambda p: see(p, seen.observation), params)
        following = None
        if isinstance(seen, Batch):
            following = see(params, seen.next_observation)
        return pull_back(cotangent), following

    @jax.jit
    def run_critic(
        params: Any, target: Params, representation: Array, following: Array, seen: Any
    ) -> Any:
        action = explore(params.actor, following)
        next_values = apply(critic, target, following, action)
        goal = losses.td_target(seen.reward, seen.discount, next_values)

        def loss(both: tuple[Params, Array]) -> Array:
            return losses.critic_loss(apply(critic, *both, seen.action), goal)

        return jax.grad(loss)((params.critic, representation))

    @jax.jit
    def run_actor(params: Any, representation: Array) -> Params:
        def loss(p: Params) -> Array:
            action = explore(p, representation)
            return losses.actor_loss(
                apply(critic, params.critic, representation, action)
            )

        return jax.grad(loss)(params.actor)

    @jax.jit
    def run_cloning(params: Any, representation: Array, action: Array) -> Any:
        def loss(p: Params, r: Array) -> Array:
            mean = jnp.tanh(apply(actor, p, r))
            return losses.cloning_loss(mean, action, std=_STD)

        return jax.grad(loss, argnums=(0, 1))(params.actor, representation)

    @jax.jit
    def run_rewarder(state: TrainState, features: Array, seen: Any, e: Any) -> Any:
        rewards = None
        if rewarder.relabel is not None:
            rewards = rewarder.relabel(state.rewarder, state.params, seen.window)
        agent = AgentView(
            seen.observation, features, seen.action, unshifted=seen.observation
        )
        return rewarder.update(state.rewarder, state.params, agent, e, key), rewards

    representation = jax.jit(see)(params.encoder, seen.observation)
    functions: dict[str, Callable[[], Any]] = {
        "encoder": lambda: run_encoder(params.encoder, seen, representation),
        "optimiser": _optimiser_step(state, learning_rate, critic_target_tau),
    }
    if batch is None:
        functions["actor"] = lambda: run_cloning(params, representation, seen.action)
        return functions
    functions["critic"] = lambda: run_critic(
        params, state.target_critic, representation, representation, seen
    )
    functions["actor"] = lambda: run_actor(params, representation)
    if rewarder.samples_expert or rewarder.relabel is not None:
        features = apply(critic, params.critic, representation, method=critic.features)
        functions["rewarder"] = lambda: run_rewarder(state, features, seen, expert)
    return functions


def _optimiser_step(
    state: TrainState, learning_rate: float, tau: float
) -> Callable[[], Any]:
    """Returns Adam on all three networks, with the parameters for gradients."""
    optimiser = optax.adam(learning_rate)
    copies = jax.tree.map(
        jnp.copy, ((state.encoder, state.actor, state.critic), state.target_critic)
    )
    held = [copies]

    # Donated, as in the update: fresh memory for 100 MB would be timed as well.
    @jax.jit(donate_argnums=0)
    def step(trees: Any, gradients: Any) -> Any:
        modules, target = trees
        modules = tuple(
            apply_gradients(module, gradient, optimiser)
            for module, gradient in zip(modules, gradients)
        )
        return modules, optax.incremental_update(modules[2].params, target, tau)

    def run() -> Any:
        held[0] = step(held[0], tuple(state.params))
        return held[0]

    return run
