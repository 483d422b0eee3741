"""Values that a control cycle makes by the dozen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

T = TypeVar("T")


@dataclass_transform(frozen_default=True)
def record(cls: type[T]) -> type[T]:
    """Return ``cls`` as a slotted dataclass that the type checker holds to be frozen.

    To freeze it at run time as well, Python sets each field through a function call, which costs
    more than all the arithmetic of a control cycle. Equal records have equal hashes.
    """
    return dataclass(slots=True, unsafe_hash=True)(cls)
