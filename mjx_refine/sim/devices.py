"""All local devices as one: the candidates of a batch are dealt out to them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "candidates"


@contextlib.contextmanager
def on_host() -> Iterator[None]:
    """JAX's work done by the CPU: small programs whose numbers are wanted at once cost a GPU more than they cost a core."""
    try:
        host = jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX was told to have nothing but the GPU
        yield
        return
    with jax.default_device(host):
        yield


@contextlib.contextmanager
def on_device() -> Iterator[None]:
    """Inside ``on_host``: JAX's work done by its usual device again."""
    with jax.default_device(None):
        yield


def has_accelerator() -> bool:
    """Whether JAX's usual device is no CPU."""
    return jax.default_backend() != "cpu"


class Devices:
    """A row of devices, each of which computes an equal part of a batch.

    Args:
      devices: by default all local devices of JAX's default backend.
    """

    def __init__(self, devices: Sequence[Any] | None = None):
        self.devices = tuple(jax.local_devices() if devices is None else devices)
        self._mesh = Mesh(np.array(self.devices), (AXIS,))

    def __len__(self) -> int:
        return len(self.devices)

    @property
    def name(self) -> str:
        """The platform, with the number of devices where there are several: ``gpu``, ``4 x gpu``."""
        platform = self.devices[0].platform
        return platform if len(self) == 1 else f"{len(self)} x {platform}"

    def dealt(self, tree: Any) -> Any:
        """``tree`` with the leading axis of every array, a multiple of the number of devices, split over the devices."""
        if len(self) == 1:
            return tree
        return jax.device_put(tree, NamedSharding(self._mesh, PartitionSpec(AXIS)))

    def spread(self, function: Callable) -> Callable:
        """``function`` of batches and to a batch, run by each device on its own part.

        Each device is then its own program: a solver's loop ends where the device's candidates have converged, not where
        all have, and no device waits for another before the end.
        """
        if len(self) == 1:
            return function
        one = PartitionSpec(AXIS)
        # The model's constants are the same everywhere, and become a candidate's own inside loops.
        return jax.shard_map(function, mesh=self._mesh, in_specs=one, out_specs=one, check_vma=False)
