"""What is slow to make, kept: the latest of it, or as long as an object lives."""

from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar

KeyT = TypeVar("KeyT")
ValueT = TypeVar("ValueT")
Key = ParamSpec("Key")


class LruCache(Generic[KeyT, ValueT]):
    """The latest of what is slow to make.

    Parameters
    ----------
    most
        How many values like a given one are kept, at least 1.
    """

    def __init__(self, most: Callable[[ValueT], int]) -> None:
        self._most = most
        self._values: OrderedDict[KeyT, ValueT] = OrderedDict()

    def get(self, key: KeyT, make: Callable[[], ValueT]) -> ValueT:
        """Return what is kept under a key, or make it."""
        if key not in self._values:
            value = make()
            while self._values and len(self._values) >= self._most(value):
                self._values.popitem(last=False)
            self._values[key] = value
        self._values.move_to_end(key)
        return self._values[key]

    def clear(self) -> None:
        """Forget everything."""
        self._values.clear()


def cached_method(
    make: Callable[Concatenate[Any, Key], ValueT],
) -> Callable[Concatenate[Any, Key], ValueT]:
    """Have a method's result made once for the same arguments, and kept as long as its object."""
    name = f"_kept_{make.__name__}"

    @wraps(make)
    def get(owner: Any, /, *key: Key.args, **named: Key.kwargs) -> ValueT:
        values: dict[object, ValueT] = owner.__dict__.setdefault(name, {})
        asked = (key, *named.items())
        if asked not in values:
            values[asked] = make(owner, *key, **named)
        return values[asked]

    return get
