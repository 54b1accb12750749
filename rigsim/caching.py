"""Cache expensive results: the latest ones, or for the lifetime of an object."""

from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

KeyT = TypeVar("KeyT")
ValueT = TypeVar("ValueT")
Key = ParamSpec("Key")
_PREFIX = "_kept_"
"""Prefix of the attributes that hold results of cached methods."""


class LruCache(Generic[KeyT, ValueT]):
    """Cache of the latest expensive results.

    Parameters
    ----------
    most
        Maximum number of cached values like a given one, at least 1.
    """

    def __init__(self, most: Callable[[ValueT], int]) -> None:
        self._most = most
        self._values: OrderedDict[KeyT, ValueT] = OrderedDict()

    def get(self, key: KeyT, make: Callable[[], ValueT]) -> ValueT:
        """Return the cached value of a key, or compute it."""
        if key not in self._values:
            self.put(key, make())
        self._values.move_to_end(key)
        return self._values[key]

    def put(self, key: KeyT, value: ValueT) -> None:
        """Cache a value as the latest one."""
        self._values.pop(key, None)
        while self._values and len(self._values) >= self._most(value):
            self._values.popitem(last=False)
        self._values[key] = value

    def clear(self) -> None:
        """Clear the cache."""
        self._values.clear()


def cached_method(
    make: Callable[Concatenate[Any, Key], ValueT],
) -> Callable[Concatenate[Any, Key], ValueT]:
    """Cache a method's results per arguments, for the lifetime of its object."""
    name = f"{_PREFIX}{make.__name__}"

    @wraps(make)
    def get(owner: Any, /, *key: Key.args, **named: Key.kwargs) -> ValueT:
        values: dict[object, ValueT] = owner.__dict__.setdefault(name, {})
        asked = (key, *named.items())
        if asked not in values:
            values[asked] = make(owner, *key, **named)
        return values[asked]

    return get


def forget_cached(owner: Any) -> None:
    """Remove the results of an object's cached methods; they are computed again on demand."""
    for name in [name for name in vars(owner) if name.startswith(_PREFIX)]:
        del vars(owner)[name]
