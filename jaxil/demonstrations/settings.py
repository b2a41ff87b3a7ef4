"""The fields `demonstrations.*` of a config."""

from jaxil.declarations import Field

DEMONSTRATIONS: dict[str, Field] = {
    "source": Field("", "a file or folder; empty: the shipped file"),
    "num_episodes": Field(
        10,
        "1, 10 or 50 in the paper; 10 takes fewer from a source of your own that "
        "has fewer",
        1,
        10**6,
    ),
    "frame_skip": Field(1, "keeps every n-th frame of a pixel file", 1, 10**4),
    "sampling": Field(
        "frames",
        "of pixel files; time: the frame nearest to each agent step, by the file's "
        "frame rate or action repeat",
        choices=("frames", "time"),
    ),
    "fit": Field(
        "stretch",
        "how frames that are not square become so: stretch, crop to the middle, or "
        "pad with black",
        choices=("stretch", "crop", "pad"),
    ),
    "action_repeat": Field(
        0, "environment frames of a stored step, if a pixel file lacks it", 0, 1000
    ),
    "camera": Field("", "of a LeRobot dataset with several"),
    "distraction": Field(
        "none",
        "as the agent's, for demonstrations of simulator states",
        choices=("none", "easy", "medium", "hard"),
    ),
}
