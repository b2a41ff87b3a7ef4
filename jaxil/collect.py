r"""Records, shows and converts demonstrations.

    jaxil collect --workdirs=runs/expert0,runs/expert1 \
        --output=cartpole_swingup.npz --num_episodes=50

evaluates the mean actions of the runs' policies and records the best. The file holds
simulator states, from which each run renders pixels for its agent; for tasks that
are not dm_control's, it holds pixels.

    jaxil collect --policy=package.module:function --task=gymnasium:ID \
        --output=FILE.npz

records a policy, a function from the task's own observation (a flat vector, or else the
image) to an action with all numbers in [-1, 1].

    jaxil collect --inspect=FILE_OR_TASK
    jaxil collect --convert=IN --output=OUT.npz

summarise a file of any format, with a contact sheet and a video, and convert it to
jaxil's format of pixels. Formats: jaxil states or pixels, ROT or PatchAIL pickles,
folders of DrQ-v2 or V-D4RL episodes, videos, folders of PNG or JPEG frames, `.npy`,
Minari and LeRobot v3 datasets.
"""

import contextlib
import functools
import os
import pathlib
import sys
from collections.abc import Iterator
from typing import Any

from absl import flags

from jaxil import command
from jaxil.config import FIELDS
from jaxil.errors import UsageError
from jaxil.files.writing import obstacle, replacing, wrong_name

_INSPECTED_SIZE, _CONVERTED_SIZE = 160, 84  # of images rendered from states
# What each job reads; all but --inspect need an output.
_JOBS = {
    "workdirs": ("trust", "num_episodes"),
    "policy": ("trust", "num_episodes", "task", "action_repeat", "image_size"),
    "inspect": ("image_size", "render_quality", "camera", "frame_skip"),
    "convert": ("image_size", "render_quality", "camera", "frame_skip", "fit"),
}
_OF_PIXELS = ("camera", "frame_skip", "fit")


def main(argv: list[str]) -> None:
    """Runs the command."""
    values = command.parse(_named_output(argv), __doc__ or "", _define, _problems)
    from jaxil.machine import startup

    print(startup.prepare(), file=sys.stderr, flush=True)
    if values.inspect:
        _inspect(values)
    elif values.convert:
        _convert(values)
    else:
        _record(values)


def _problems(values: flags.FlagValues) -> list[str]:
    """Returns faults of the flags together, some of which would show after minutes."""
    jobs = [name for name in _JOBS if values[name].value]
    if len(jobs) != 1:
        names = ", ".join(f"--{name}" for name in _JOBS)
        given = ", ".join(f"--{name}" for name in jobs) or "none"
        faults = [f"exactly one of {names} is required; given: {given}"]
        return faults + _output_faults(values)
    read = (*jobs, "output", *_JOBS[jobs[0]])
    present = [name for name in values if values[name].present]
    faults = [
        f"--{name} is not for --{jobs[0]}: leave it out"
        for name in present
        if name not in read
    ]
    source = values.inspect or values.convert
    if source and _holds_states(source):
        faults += [
            f"--{name} is for pixels, but {source} holds simulator states: leave it out"
            for name in present
            if name in _OF_PIXELS and name in read
        ]
    if values.policy and not values.task:
        faults.append("--task is missing: name the policy's task")
    return faults + _output_faults(values)


def _record(values: flags.FlagValues) -> None:
    from jaxil import record

    output = pathlib.Path(values.output)
    if values.workdirs:
        folders = [pathlib.Path(folder) for folder in values.workdirs]
        record.best_of_runs(folders, output, num_episodes=values.num_episodes)
        return
    names = ("task", "action_repeat", "image_size", "num_episodes")
    settings: Any = {name: values[name].value for name in names}
    record.policy(values.policy, output, **settings)


def _inspect(values: flags.FlagValues) -> None:
    from jaxil.demonstrations import inspection, states
    from jaxil.files.video import write_video
    from jaxil.machine import memory
    from jaxil.machine.progress import shown

    flag = f"--inspect={values.inspect}"
    with _reported(values.inspect, flag), shown("inspecting") as progress:
        path = states.located(values.inspect)
        seen = inspection.inspect(
            path,
            progress=progress,
            image_size=values.image_size or _INSPECTED_SIZE,
            render_quality=values.render_quality,
            max_bytes=memory.spare_bytes(),
            camera=values.camera or "",
            frame_skip=values.frame_skip,
        )
    name = path.resolve().stem
    # Never the input itself, which may be a video in this folder.
    folder = pathlib.Path(values.output or ".")
    sheet, video = folder / f"{name}_sheet.png", folder / f"{name}_episode0.mp4"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(sheet) as temporary:
            inspection.contact_sheet(seen).save(temporary, format="png")
        write_video(video, seen.video, fps=seen.frames_per_second, labels=(name, ""))
    except OSError as error:
        raise UsageError(f"--output={folder}: {error}") from error
    print(inspection.table(seen))  # last, because `| head` may end the process
    print(f"contact sheet: {sheet}\nvideo of episode 0: {video}")


def _convert(values: flags.FlagValues) -> None:
    from jaxil.demonstrations import foreign, inspection, states
    from jaxil.demonstrations.readers import own
    from jaxil.machine import memory

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
                max_bytes=memory.spare_bytes(),
                frame_skip=values.frame_skip,
                image_size=values.image_size or _CONVERTED_SIZE,
                keep_aspect=values.image_size is None,
                fit=values.fit,
                camera=values.camera or "",
            )
        own.write_pixels(output, recording, origin=f"{recording.kind}, {path.name}")
    print(
        f"{output}: {recording.num_episodes} episodes of {recording.kind}, "
        f"{output.stat().st_size / 1e6:.2f} MB"
    )


@contextlib.contextmanager
def _reported(path: pathlib.Path | str, flags_given: str) -> Iterator[None]:
    """Turns errors of a user's file into a UsageError."""
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


def _holds_states(source: str) -> bool:
    from jaxil.demonstrations import states

    try:
        return states.recognises(states.located(source))
    except states.DemonstrationError:
        return False


def _output_faults(values: flags.FlagValues) -> list[str]:
    """Returns faults of --output that would otherwise show only after minutes."""
    if values.output is None:
        return [] if values.inspect else ["--output=NAME.npz is missing"]
    output = pathlib.Path(values.output)
    is_folder = os.path.isdir(output)
    if values.inspect and os.path.exists(output) and not is_folder:
        return [f"--output={output} must be a folder"]
    if is_folder and not values.inspect:
        return [f"--output={output} is a folder: name a file, NAME.npz"]
    if values.convert and os.path.realpath(output) == os.path.realpath(values.convert):
        return [f"--output={output} is the file to convert: name another one"]
    why = wrong_name(output) or obstacle(output if values.inspect else output.parent)
    return [f"--output={output} cannot be written ({why}): name another"] if why else []


def _named_output(argv: list[str]) -> list[str]:
    """Rewrites `--convert IN OUT` as `--convert=IN --output=OUT`."""
    if "--convert" not in argv:
        return argv
    index = argv.index("--convert")
    words = argv[index + 1 : index + 3]
    if len(words) < 2 or any(word.startswith("-") for word in words):
        return argv
    named = [f"--convert={words[0]}", f"--output={words[1]}"]
    return [*argv[:index], *named, *argv[index + 3 :]]


def _define(values: flags.FlagValues) -> None:
    define_text = functools.partial(
        flags.DEFINE_string, default=None, flag_values=values
    )
    define_number = functools.partial(flags.DEFINE_integer, flag_values=values)
    flags.DEFINE_list(
        "workdirs",
        [],
        "comma-separated folders of runs of one task, of which the best is recorded",
        flag_values=values,
    )
    define_text(
        "policy", help="package.module:function, observation -> action, to record"
    )
    define_text("task", help="for --policy: the task, as in configs")
    define_number("action_repeat", 2, "for --policy: frames of one step", 1, 100)
    command.define_trust(values)
    define_text("inspect", help="file or folder of any format, or task, to show")
    define_text(
        "convert", help="file or folder to convert to pixels; also --convert IN OUT"
    )
    define_text(
        "output", help="NAME.npz; for --inspect a folder for contact sheet and video"
    )
    define_number("num_episodes", 50, "for --workdirs, --policy: episodes", 1, 10_000)
    image_size = "of images; without it videos shrink to 84 or 160, pixels keep theirs"
    define_number("image_size", None, image_size, 8, 1024)
    define_choice = functools.partial(flags.DEFINE_enum, flag_values=values)
    quality, fit = FIELDS["render_quality"], FIELDS["demonstrations.fit"]
    how = "how --convert and --inspect render states"
    define_choice("render_quality", quality.default, quality.choices, how)
    how = "how --convert --image_size makes frames square"
    define_choice("fit", fit.default, fit.choices, how)
    define_text("camera", help="which camera of a LeRobot dataset to read")
    define_number("frame_skip", 1, "keeps every N-th frame of pixels", 1, 10_000)


if __name__ == "__main__":
    command.run(main)
