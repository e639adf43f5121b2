"""Registry of the builds: the examples of all kernels."""

from __future__ import annotations

from gpuvision.profiling.offline import matching_builds, ranging_builds, simulation_builds
from gpuvision.profiling.offline.builds import Example, KernelBuild, builds_of


def all_examples() -> list[Example]:
    """Return the examples of all kernel files.

    Raises
    ------
    NoDeviceError
        There is no OpenCL device: the examples of the pose search hold a distance map, which a device computes.
    """
    return [*ranging_builds.examples(), *matching_builds.examples(), *simulation_builds.examples()]


def all_builds() -> list[KernelBuild]:
    """Return the builds of all kernel files, in the order of the files; raises what `all_examples` raises."""
    builds = [*builds_of(all_examples()), KernelBuild("copy, multiply-adds", "ceiling/ceiling.cl", {})]
    return sorted(builds, key=lambda each: each.source)
