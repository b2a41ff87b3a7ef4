r"""Records, shows and converts demonstrations.

    python -m jaxil.collect --workdirs=runs/expert0,runs/expert1 \
        --output=cartpole_swingup.npz --num_episodes=50

evaluates the policies of one or several runs by their mean actions; the best one plays
the episodes. The file holds simulator states, not pixels: whoever trains renders them
as their agent sees.

    python -m jaxil.collect --inspect=FILE
    python -m jaxil.collect --convert=IN --output=OUT.npz

print what a file of any format holds, with a contact sheet and a video, and write it as
jaxil's own file of pixels. Formats: jaxil states or pixels, ROT or PatchAIL pickles,
folders of DrQ-v2 or V-D4RL episodes, videos, Minari and LeRobot v3 datasets.
"""

import contextlib
import functools
import pathlib
import sys
import tempfile
from collections.abc import Iterator

from absl import flags

from jaxil import command
from jaxil.errors import UsageError

_NUM_EVAL_EPISODES = 10
# The recording environment's seed: shared by no training and no evaluation.
_SEED = 777
# Height and width of images rendered from states, unless --image_size is given.
_INSPECTED_SIZE, _CONVERTED_SIZE = 160, 84
_JOBS = ("workdirs", "inspect", "convert")


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(_named_output(argv), __doc__ or "", _define)
    jobs = [name for name in _JOBS if values[name].value]
    faults = []
    if len(jobs) != 1:
        names = ", ".join(f"--{name}" for name in _JOBS)
        given = ", ".join(f"--{name}" for name in jobs) or "none"
        faults.append(f"exactly one of {names} is needed, and given: {given}")
    faults += _output_faults(values)
    if faults:
        raise UsageError(faults)
    from jaxil.machine import startup

    print(startup.prepare(), file=sys.stderr, flush=True)
    {"workdirs": _record, "inspect": _inspect, "convert": _convert}[jobs[0]](values)


def _record(values: flags.FlagValues) -> None:
    """Records the best of several policies."""
    import numpy as np

    from jaxil.demonstrations import playing, states
    from jaxil.environments.evaluation import evaluate
    from jaxil.training import assembly, trained

    runs = [trained.load(pathlib.Path(folder)) for folder in values.workdirs]
    tasks = sorted({run.config.task for run in runs})
    if len(tasks) > 1:
        raise UsageError(
            f"--workdirs hold runs of different tasks ({', '.join(tasks)}); give the "
            "seeds of one task"
        )
    means = []
    print(f"{'mean':>8}{'std':>8}{'frames':>10}{'minutes':>9}  run")
    for folder, run in zip(values.workdirs, runs, strict=True):
        evaluation = evaluate(
            run.environment, run.act, num_episodes=_NUM_EVAL_EPISODES, first_episode=0
        )
        means.append(evaluation.mean)
        print(
            f"{evaluation.mean:>8.1f}{evaluation.std:>8.1f}{run.frame:>10}"
            f"{run.seconds / 60:>9.0f}  {folder}",
            flush=True,
        )
    best = runs[int(np.argmax(means))]
    environment = assembly.environment_with_seed(best.config, _SEED)
    arrays = playing.play(
        environment, lambda _: lambda _, seen: best.act(seen), values.num_episodes
    )
    metadata = states.new_metadata(
        task=best.config.task,
        action_repeat=best.config.action_repeat,
        seed=_SEED,
        first_episode=0,
        expert=f"{best.description()}; mean action, no noise",
        rewards=arrays["rewards"],
    )
    output = pathlib.Path(values.output)
    try:
        states.write_states(
            output, states.StateDemonstrations(**arrays, metadata=metadata)
        )
    except (OSError, states.DemonstrationError) as error:
        raise UsageError(f"--output={output}: {error}") from error
    returns = arrays["rewards"].sum(axis=1)
    print(
        f"{output}: {len(returns)} episodes of {values.workdirs[int(np.argmax(means))]}"
        f", return mean {returns.mean():.1f}, minimum {returns.min():.1f}, maximum "
        f"{returns.max():.1f}, {output.stat().st_size / 1e6:.2f} MB"
    )


def _inspect(values: flags.FlagValues) -> None:
    """Prints a table; writes a contact sheet and a video."""
    from jaxil.demonstrations import inspection
    from jaxil.files.video import write_video

    path = pathlib.Path(values.inspect)
    with _reported(path, f"--inspect={path}"):
        seen = inspection.inspect(
            path,
            image_size=values.image_size or _INSPECTED_SIZE,
            render_quality=values.render_quality,
            max_bytes=_max_bytes(),
        )
    name = path.resolve().stem
    # Never the name of the input, which may be a video in this very folder.
    folder = pathlib.Path(values.output or ".")
    sheet, video = folder / f"{name}_sheet.png", folder / f"{name}_episode0.mp4"
    try:
        temporary = sheet.with_suffix(".part")
        inspection.contact_sheet(seen).save(temporary, format="png")
        temporary.replace(sheet)
        write_video(video, seen.video, fps=seen.frames_per_second, labels=(name, ""))
    except OSError as error:
        raise UsageError(f"--output={folder}: {error}") from error
    # Last, so that `| head` cuts nothing short.
    print(inspection.table(seen))
    print(f"contact sheet: {sheet}\nvideo of episode 0: {video}")


def _convert(values: flags.FlagValues) -> None:
    """Writes a file of any format as jaxil's own file of pixels."""
    from jaxil.demonstrations import foreign, inspection, states
    from jaxil.demonstrations.readers import own

    path, output = pathlib.Path(values.convert), pathlib.Path(values.output)
    with _reported(path, f"--convert={path} --output={output}"):
        if states.recognises(path):
            recording = inspection.render_recording(
                path,
                image_size=values.image_size or _CONVERTED_SIZE,
                render_quality=values.render_quality,
            )
        else:
            recording = foreign.open_recording(
                path,
                max_bytes=_max_bytes(),
                frame_skip=values.frame_skip,
                image_size=values.image_size,
            )
        own.write_pixels(output, recording, origin=f"{recording.kind}, {path.name}")
    print(
        f"{output}: {recording.num_episodes} episodes of {recording.kind}, "
        f"{output.stat().st_size / 1e6:.2f} MB"
    )


@contextlib.contextmanager
def _reported(path: pathlib.Path, flags_given: str) -> Iterator[None]:
    """Turns what may be wrong with a user's file into one message."""
    from jaxil.demonstrations.states import DemonstrationError

    try:
        yield
    except DemonstrationError as error:
        raise UsageError(str(error)) from error
    except ValueError as error:  # a FormatError among them
        raise UsageError(f"{path} {error}.") from error
    except OSError as error:
        raise UsageError(
            f"{flags_given} cannot be read or written ({error.strerror or error})"
        ) from error


def _output_faults(values: flags.FlagValues) -> list[str]:
    """Returns why the output cannot be written, before minutes of work are lost."""
    if values.output is None:
        if values.inspect:
            return []
        return ["--output is missing: name the file to write, NAME.npz"]
    output = pathlib.Path(values.output)
    if values.inspect:
        if output.is_dir():
            return []
        return [f"--output={output} must be a folder that exists"]
    if output.is_dir():
        return [f"--output={output} is a folder: name a file, NAME.npz"]
    if values.convert and output.resolve() == pathlib.Path(values.convert).resolve():
        return [f"--output={output} is the file to convert: name another one"]
    folder = next(parent for parent in output.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            return []
    except OSError as error:
        return [
            f"--output={output} cannot be written ({error.strerror or error}): name "
            "a file in another folder"
        ]


def _named_output(argv: list[str]) -> list[str]:
    """Lets people write `--convert IN OUT` for `--convert=IN --output=OUT`."""
    if "--convert" not in argv:
        return argv
    index = argv.index("--convert")
    words = argv[index + 1 : index + 3]
    if len(words) < 2 or any(word.startswith("-") for word in words):
        return argv
    named = [f"--convert={words[0]}", f"--output={words[1]}"]
    return [*argv[:index], *named, *argv[index + 3 :]]


def _max_bytes() -> int:
    """Returns how much memory one array of a file may take."""
    from jaxil.machine import memory

    return memory.spare_bytes()


def _define(values: flags.FlagValues) -> None:
    text = functools.partial(flags.DEFINE_string, default=None, flag_values=values)
    number = functools.partial(flags.DEFINE_integer, flag_values=values)
    flags.DEFINE_list(
        "workdirs",
        [],
        "folders of runs of one task, comma-separated, to record the best of",
        flag_values=values,
    )
    text("inspect", help="file or folder to show, of any format")
    text(
        "convert",
        help="file or folder of any format to write as pixels; also --convert IN OUT",
    )
    text(
        "output",
        help="file to write, NAME.npz; with --inspect the folder for sheet and video",
    )
    number("num_episodes", 50, "episodes to record", 1, 10_000)
    number(
        "image_size",
        None,
        "height and width for --convert and --inspect; without it pixels keep theirs",
        8,
        1024,
    )
    flags.DEFINE_enum(
        "render_quality",
        "paper",
        ["paper", "fast", "smooth"],
        "how --convert and --inspect render states",
        flag_values=values,
    )
    number("frame_skip", 1, "--convert keeps every N-th frame of pixels", 1, 10_000)


if __name__ == "__main__":
    command.run(main)
