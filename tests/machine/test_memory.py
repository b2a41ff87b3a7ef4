"""Available memory on made-up machines."""

import pytest

from jaxil.machine import memory


def machine(root, files):
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


MEMINFO = {"proc/meminfo": "MemTotal:  2000 kB\nMemAvailable:    1000 kB\n"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({}, None),
        (MEMINFO, 1_024_000),
        (
            # A container: 500000 of which 200000 are used, 50000 of them file cache.
            MEMINFO
            | {
                "sys/fs/cgroup/memory.max": "500000\n",
                "sys/fs/cgroup/memory.current": "200000\n",
                "sys/fs/cgroup/memory.stat": "anon 1\ninactive_file 50000\n",
            },
            350_000,
        ),
        (
            MEMINFO
            | {
                "sys/fs/cgroup/memory.max": "max\n",
                "sys/fs/cgroup/memory.current": "200000\n",
            },
            1_024_000,
        ),
        (
            # A batch job: the limit is on a parent of the process's own group.
            MEMINFO
            | {
                "proc/self/cgroup": "0::/slurm/job_1/step_0\n",
                "sys/fs/cgroup/slurm/job_1/memory.max": "300000\n",
                "sys/fs/cgroup/slurm/job_1/memory.current": "100000\n",
                "sys/fs/cgroup/slurm/job_1/step_0/memory.max": "max\n",
                "sys/fs/cgroup/slurm/job_1/step_0/memory.current": "90000\n",
            },
            200_000,
        ),
        (
            # The older layout, over its limit: nothing is left.
            MEMINFO
            | {
                "proc/self/cgroup": "3:cpu:/a\n2:memory:/a\n",
                "sys/fs/cgroup/memory/a/memory.limit_in_bytes": "1000\n",
                "sys/fs/cgroup/memory/a/memory.usage_in_bytes": "2000\n",
            },
            0,
        ),
    ],
)
def test_the_tightest_limit_counts(tmp_path, files, expected):
    assert memory.available_bytes(machine(tmp_path, files)) == expected


def test_demonstrations_that_were_checked_do_not_lower_their_own_limit(monkeypatch):
    memory.spare_bytes.cache_clear()
    left = iter([16 * 2**30, 9 * 2**30])  # before a file is read, and after
    monkeypatch.setattr(memory, "available_bytes", lambda: next(left))
    assert memory.spare_bytes() == memory.spare_bytes() == 8 * 2**30
    memory.spare_bytes.cache_clear()
