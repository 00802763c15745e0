"""The libraries that factorbus runs on, and which versions of them are installed."""

from importlib import metadata

LIBRARIES = ("eclipse-zenoh", "msgpack", "numpy", "numba", "llvmlite", "scipy", "scikit-sparse", "matplotlib")


def installed(distribution: str) -> str | None:
    """The installed version of `distribution`, or None."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
