"""The learner's state: everything that training changes."""

from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from jaxil.maths.types import Params


class LearnerParams(NamedTuple):
    """The parameters that rewarders and policies may read.

    Attributes:
      encoder: of pixels, shared by actor and critic.
      actor: policy.
      critic: live twin critics.
    """

    encoder: Params
    actor: Params
    critic: Params


class PolicyParams(NamedTuple):
    """The parameters that a policy acts with."""

    encoder: Params
    actor: Params


class ModuleState(struct.PyTreeNode):
    """Parameters of one network with the state of its optimiser."""

    params: Params
    opt_state: optax.OptState


class TrainState(struct.PyTreeNode):
    """All that `update_step` reads and writes; a pytree, donated at each call.

    Hyperparameters are absent on purpose: the update closes over them, so a
    checkpoint holds learned values only.

    Attributes:
      encoder: trained by the critic loss alone; by cloning in BC, BCO and BCV-LR.
      actor: trained by the actor loss; by cloning in those three.
      critic: trained by the critic loss; not trained in those three.
      target_critic: slow copy of the critic's parameters.
      rewarder: what the imitation method learns or remembers.
      key: base random key. Never consumed: update number n uses
        `fold_in(key, n)`, so a resumed run has the random numbers of an
        uninterrupted one.
      num_updates: gradient steps so far. Shape [], int32.
      average: of all policies so far, see `averaging.average_policy`; None where the
        newest is evaluated.
    """

    encoder: ModuleState
    actor: ModuleState
    critic: ModuleState
    target_critic: Params
    rewarder: Any
    key: Array
    num_updates: Array
    average: PolicyParams | None = None

    @property
    def params(self) -> LearnerParams:
        """The live parameters, for policies and rewarders."""
        return LearnerParams(self.encoder.params, self.actor.params, self.critic.params)

    @property
    def newest_policy(self) -> PolicyParams:
        """The policy that collects experience."""
        return PolicyParams(self.encoder.params, self.actor.params)

    @property
    def policy(self) -> PolicyParams:
        """The policy that is evaluated."""
        return self.newest_policy if self.average is None else self.average


def init_module(params: Params, optimiser: optax.GradientTransformation) -> ModuleState:
    """Returns `params` with fresh optimiser statistics."""
    return ModuleState(params=params, opt_state=optimiser.init(params))


Module = TypeVar("Module", bound=ModuleState)


def apply_gradients(
    module: Module, gradients: Params, optimiser: optax.GradientTransformation
) -> Module:
    """Returns `module` after one optimiser step, other fields unchanged."""
    updates, opt_state = optimiser.update(gradients, module.opt_state, module.params)
    params = optax.apply_updates(module.params, updates)
    return module.replace(params=params, opt_state=opt_state)


def copy_params(params: Params) -> Params:
    """Returns a copy in separate buffers.

    Two trees that share buffers cannot both be donated to one call.
    """
    return jax.tree.map(jnp.copy, params)
