"""How our functions call parts: with fewer words, and fewer instructions around them, than Numba calls a function.

A dense array that a part is given is borrowed, so it is passed as its address and its shape: what else Numba keeps of
an array, eight words of eleven of one with two dimensions, follows from these.  What a part fails with goes straight to
who called its caller.  Of a part that returns an array the arrays are passed whole, because it may return one of them.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from llvmlite.ir.instructions import InsertValue
from numba.core import cgutils, imputils, types
from numba.core.callconv import RETCODE_OK, errcode_t, excinfo_ptr_t

__all__ = ["FoldingBuilder", "arguments_of", "caller_of", "declare_part", "has_short_call", "is_short"]

_WORD = ir.IntType(64)


class FoldingBuilder(ir.IRBuilder):
    """Writes no instruction to take out of a record or an array what was put into it in the same function."""

    def extract_value(self, agg: Any, idx: Any, name: str = "") -> Any:
        """What is at this place; a number, or the numbers of the way to it."""
        path = tuple(idx) if isinstance(idx, tuple | list) else (idx,)
        while isinstance(agg, InsertValue):
            place = tuple(agg.indices)
            if path[: len(place)] == place:
                rest = path[len(place) :]
                return self.extract_value(agg.value, rest, name) if rest else agg.value
            if place[: len(path)] == path:
                break  # a part of what is asked for
            agg = agg.aggregate
        return super().extract_value(agg, path, name)


def has_short_call(described: Any) -> bool:
    """Whether a part is called so.  One that may return nothing says that by its code, which Numba looks at."""
    return not isinstance(described.restype, types.Optional)


def declare_part(context: Any, module: Any, described: Any) -> Any:
    """The part in a module: its code or, in one that calls it, its name."""
    words = [word for kind in described.argtypes for word in _words_of(context, described, kind)]
    result = context.call_conv.get_return_type(described.restype)
    kind = ir.FunctionType(errcode_t, [result, excinfo_ptr_t.as_pointer(), *words])
    function = cgutils.get_or_insert_function(module, kind, described.mangled_name)
    for argument in function.args[:2]:
        argument.add_attribute("captures(none)")
        argument.add_attribute("noalias")
    if described.inline:
        function.attributes.add("alwaysinline")
    return function


def arguments_of(context: Any, builder: Any, described: Any, function: Any) -> list[Any]:
    """What a part was given, as values of its own."""
    words = list(function.args[2:])
    return [_from_words(context, builder, described, kind, words) for kind in described.argtypes]


def caller_of(described: Any, libraries: tuple[Any, ...]) -> Callable[..., Any]:
    """What writes a call of the part."""

    def call(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        words = [
            word
            for kind, value in zip(described.argtypes, args, strict=True)
            for word in _as_words(context, builder, described, kind, value)
        ]
        function = declare_part(context, builder.module, described)
        with builder.goto_entry_block():
            place = builder.alloca(function.function_type.args[0].pointee)
        code = builder.call(function, [place, builder.function.args[1], *words])
        with cgutils.if_unlikely(builder, builder.icmp_unsigned("!=", code, RETCODE_OK)):
            builder.ret(code)
        result = context.get_returned_value(builder, described.restype, builder.load(place))
        return imputils.impl_ret_new_ref(context, builder, signature.return_type, result)

    made: Any = call
    made.signature, made.libs = described.argtypes, libraries
    return made


def is_short(context: Any, described: Any, kind: Any) -> bool:
    """Whether an argument, or what is in it, is passed as an address and a shape."""
    if type(kind) is not types.Array or kind.layout != "C":
        return False
    return not context.data_model_manager[described.restype].contains_nrt_meminfo()


def _is_tuple(kind: Any) -> bool:
    return isinstance(kind, types.BaseTuple)


def _words_of(context: Any, described: Any, kind: Any) -> list[Any]:
    """The types of the words that an argument is passed in."""
    if is_short(context, described, kind):
        return [context.get_value_type(types.CPointer(kind.dtype)), *[_WORD] * kind.ndim]
    if _is_tuple(kind):
        return [word for one in kind.types for word in _words_of(context, described, one)]
    return list(context.get_arg_packer([kind]).argument_types)


def _as_words(context: Any, builder: Any, described: Any, kind: Any, value: Any) -> list[Any]:
    if is_short(context, described, kind):
        model = context.data_model_manager[kind]
        shape = model.get_field_position("shape")
        sizes = [builder.extract_value(value, (shape, k)) for k in range(kind.ndim)]
        return [model.get(builder, value, "data"), *sizes]
    if _is_tuple(kind):
        inside = [(one, builder.extract_value(value, k)) for k, one in enumerate(kind.types)]
        return [word for one, part in inside for word in _as_words(context, builder, described, one, part)]
    return list(context.get_arg_packer([kind]).as_arguments(builder, [value]))


def _from_words(context: Any, builder: Any, described: Any, kind: Any, words: list[Any]) -> Any:
    """An argument, of as many of the words as it takes, which are taken away."""
    if is_short(context, described, kind):
        return _array(context, builder, kind, words.pop(0), [words.pop(0) for _ in range(kind.ndim)])
    if _is_tuple(kind):
        made = ir.Constant(context.get_value_type(kind), ir.Undefined)
        for k, one in enumerate(kind.types):
            made = builder.insert_value(made, _from_words(context, builder, described, one, words), k)
        return made
    packer = context.get_arg_packer([kind])
    own = [words.pop(0) for _ in packer.argument_types]
    return packer.from_arguments(builder, own)[0]


def _array(context: Any, builder: Any, kind: Any, data: Any, shape: list[Any]) -> Any:
    """The array at this address, of which nobody counts the references."""
    size = _WORD(context.get_abi_sizeof(context.get_data_type(kind.dtype)))
    model, of = context.data_model_manager[kind], context.get_value_type(kind)
    at = {name: model.get_field_position(name) for name in ("itemsize", "nitems", "data", "shape", "strides")}
    known = [ir.Constant(field, ir.Undefined) for field in of.elements]
    for name in ("meminfo", "parent"):
        place = model.get_field_position(name)
        known[place] = ir.Constant(of.elements[place], None)
    array = builder.insert_value(ir.Constant(of, known), data, at["data"])
    array = builder.insert_value(array, size, at["itemsize"])
    entries, stride = None, size
    for k in reversed(range(kind.ndim)):
        array = builder.insert_value(array, shape[k], (at["shape"], k))
        array = builder.insert_value(array, stride, (at["strides"], k))
        entries = shape[k] if entries is None else builder.mul(entries, shape[k])
        if k:
            stride = builder.mul(stride, shape[k])
    return array if entries is None else builder.insert_value(array, entries, at["nitems"])
