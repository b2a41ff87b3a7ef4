r"""Writes a run's policy to a folder that needs neither jaxil nor its networks.

    jaxil export --workdir=runs/pdac --output=policy

The folder holds policy.stablehlo (mean actions of the newest checkpoint, any batch
size, for CPU and CUDA), settings.json (shapes, task, action repeat, frame stack) and
reader.py, which needs jax and flatbuffers:

    import reader
    actions = reader.act(observations)
"""

import json
import pathlib
from typing import Any

from absl import flags

from jaxil import command
from jaxil.errors import Fault, UsageError

_READER = '''"""Acts with the policy of this folder; needs jax and flatbuffers."""

import pathlib

import jax
from jax import export

_FILE = pathlib.Path(__file__).with_name("policy.stablehlo")
# Observations [B, ...], see settings.json -> actions, float32 [B, A] in [-1, 1].
act = jax.jit(export.deserialize(bytearray(_FILE.read_bytes())).call)
'''
_PLATFORMS = ("cpu", "cuda")
# Beside shapes, what a user has to know to show the policy what it was trained on.
_SETTINGS = (
    *("task", "observation", "action_repeat", "frame_stack"),
    *("camera", "render_quality", "distraction"),
)


def main(argv: list[str]) -> None:
    """Runs the command."""
    from jaxil.machine import startup
    from jaxil.training import workdir

    values = command.parse(argv, __doc__ or "", _define, workdir.run_problems)
    folder = workdir.from_flag(values.workdir)
    output = pathlib.Path(values.output)
    startup.prepare()
    from jaxil.files.writing import write_atomically
    from jaxil.training import trained

    policy = trained.load_policy(folder)
    settings = {
        **{name: policy.config[name] for name in _SETTINGS},
        "observation_shape": policy.observation_shape,
        "observation_dtype": policy.observation_dtype.__name__,
        "frame": policy.frame,
    }
    try:
        output.mkdir(parents=True, exist_ok=True)
        write_atomically(output / "policy.stablehlo", serialized(policy))
        text = json.dumps(settings, indent=2) + "\n"
        write_atomically(output / "settings.json", text.encode())
        write_atomically(output / "reader.py", _READER.encode())
    except OSError as error:
        rule = f"cannot be written ({error.strerror or error})"
        way_out = "name a new folder of yours"
        raise UsageError(Fault("--output", rule, way_out, str(output))) from error
    size = (output / "policy.stablehlo").stat().st_size / 1e6
    print(f"{output}: policy of frame {policy.frame}, {size:.1f} MB; see reader.py")


def serialized(policy: Any) -> bytes:
    """Returns a `trained.Policy` as StableHLO with a symbolic batch size."""
    import jax
    from jax import export

    from jaxil.learner.policy import make_mean_action
    from jaxil.training import agent as agents

    config, params = policy.config.copy_and_resolve_references(), policy.params
    # The encoder in C exists only where jaxil does.
    config.encoder.convolutions = "xla"
    networks = policy.networks
    mean = getattr(networks.encoder, "mean", 0.5)
    portable = agents.make_networks(config, networks.actor.action_dim, mean)
    mean_action = make_mean_action(portable)
    (batch,) = export.symbolic_shape("b")
    shape = jax.ShapeDtypeStruct(
        (batch, *policy.observation_shape), policy.observation_dtype
    )
    act = jax.jit(lambda seen: mean_action(params.encoder, params.actor, seen))
    return bytes(export.export(act, platforms=_PLATFORMS)(shape).serialize())


def _define(values: flags.FlagValues) -> None:
    flags.DEFINE_string("workdir", None, "folder of the run", flag_values=values)
    command.define_trust(values)
    flags.DEFINE_string(
        "output",
        "policy",
        "folder to write; files of an earlier export are replaced",
        flag_values=values,
    )


if __name__ == "__main__":
    command.run(main)
