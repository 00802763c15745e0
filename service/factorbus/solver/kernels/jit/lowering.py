"""How Numba makes machine code of our functions: its own compiler, but for what is changed here.

Arrays that a function is given are borrowed.  Of indices only constants count from the end.  A number of an array is
read and written in a few instructions.  A part stays as it was written until a kernel links it, and what a kernel links
is its own.

All of this is Numba's private side, so it is done with releases that were tested (`releases`), and three functions of
Numba's are exchanged only while a function of ours is compiled (`changed_numba`), six in a process that compiles for
others alone.  What each change is worth is in docs/decisions/private-numba.md.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import llvmlite.binding
from llvmlite import ir
from llvmlite.binding import create_new_function_pass_manager, create_pass_builder, create_pipeline_tuning_options
from numba.core import cgutils, config, event, types
from numba.core import ir as numba_ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.runtime.context import NRTContext
from numba.core.typed_passes import BaseNativeLowering, NativeLowering
from numba.np import arrayobj
from numba.np.arrayobj import load_item, store_item

from .held import FoldingBuilder, drop_unused, find_held
from .shared import compiles_for_others

_LEVEL = int(getattr(config, "OPT"))  # noqa: B009  (Numba sets it when it is imported)
_from_the_end = arrayobj.fix_integer_index


def _fix_integer_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """In our own code only constants count from the end."""
    constant = isinstance(kind, types.IntegerLiteral) or isinstance(index, ir.Constant)
    if constant or not getattr(builder.module, "factorbus", False):
        return _from_the_end(context, builder, kind, index, size)
    return context.cast(builder, index, kind, types.intp)


class OurLower(Lower):
    """The code of our functions: it says that it is, and borrows arrays.

    Arrays that a function is given belong to its caller, who keeps them until it returns: it counts no references.

    Numba counts one more and one less for each row or block of them that is looked at, by atomic operations: up to
    four fifths of the time of short kernels.  A function that gives back an array may give back one that it was given,
    so such a one does count.  One that has no arrays but those, and their rows and blocks, counts nothing at all.
    """

    def init(self) -> None:
        self.module.factorbus = True
        self.module.factorbus_borrows = self._is_plain(self.fndesc.restype) and not any(
            self._is_owner(expression, signature) for expression, signature in self.fndesc.calltypes.items()
        )
        super().init()

    def setup_function(self, fndesc: Any) -> None:
        super().setup_function(fndesc)
        self.builder = FoldingBuilder(self.entry_block)
        self.call_helper = self.call_conv.init_call_helper(self.builder)

    def lower_normal_function(self, fndesc: Any) -> None:
        super().lower_normal_function(fndesc)
        drop_unused(self.function)

    def _find_singly_assigned_variable(self) -> None:
        super()._find_singly_assigned_variable()
        self._singly_assigned_vars |= {name for name in find_held(self.blocks) if self._counts_nothing(name)}

    def _is_owner(self, expression: Any, signature: Any) -> bool:
        """Whether what it comes to may be, or have, an array of its own."""
        if signature is None or self._is_plain(signature.return_type):
            return False
        looks_at = getattr(expression, "op", None) in {"getitem", "static_getitem"}
        return not looks_at or any(map(_has_array, signature.args[1:]))

    def _counts_nothing(self, name: str) -> bool:
        return self.module.factorbus_borrows or self._is_plain(self.typeof(name))

    def _is_plain(self, kind: Any) -> bool:
        """Whether there are no references to count in it."""
        return not self.context.data_model_manager[kind].contains_nrt_meminfo()

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        given = inst.value
        borrowed = isinstance(given, numba_ir.Arg) and isinstance(ty, types.Array)
        if not (borrowed and self._is_plain(self.fndesc.restype)):
            return super().lower_assign(ty, inst)
        value = self.context.cast(self.builder, self.fnargs[given.index], self.typeof(f"arg.{given.name}"), ty)
        array = self.context.make_array(ty)(self.context, self.builder, value)
        array.meminfo, array.parent = (cgutils.get_null_value(owner.type) for owner in (array.meminfo, array.parent))
        return array._getvalue()

    def delvar(self, name: str) -> None:
        """Nothing, where there is no reference to give up.  Numba loads what is not needed any more, and stores 0."""
        if not self._counts_nothing(name):
            super().delvar(name)

    def storevar(self, value: Any, name: str, argidx: Any = None) -> None:
        """Without a look at what was there before, where it has no reference to give up."""
        if name in self._singly_assigned_vars or not self._counts_nothing(name):
            super().storevar(value, name, argidx)
        else:
            self.builder.store(value, self.getvar(name))

    def lower_getitem(self, resty: Any, expr: Any, value: Any, index: Any, signature: Any) -> Any:
        place = self._place_of_number(value.name, index.name)
        if place is None:
            return super().lower_getitem(resty, expr, value, index, signature)
        array = self.typeof(value.name)
        return self.context.cast(self.builder, load_item(self.context, self.builder, array, place), array.dtype, resty)

    def lower_setitem(self, target_var: Any, index_var: Any, value_var: Any, signature: Any) -> Any:
        given, into = self.typeof(value_var.name), self.typeof(target_var.name)
        if isinstance(into, types.Array) and isinstance(given, types.Array):
            # Not a path that is missing: thirty functions of Numba's, to say of arrays of unlike sizes what they are.
            raise NotImplementedError(f"{given}, assigned to a part of another array; a kernel copies number by number")
        place = self._place_of_number(target_var.name, index_var.name)
        if place is None:
            return super().lower_setitem(target_var, index_var, value_var, signature)
        array = self.typeof(target_var.name)
        number = self.loadvar(value_var.name)
        for before, after in pairwise((self.typeof(value_var.name), signature.args[2], array.dtype)):
            number = self.context.cast(self.builder, number, before, after)
        return store_item(self.context, self.builder, array, number, place)

    def _place_of_number(self, name: str, index: str) -> Any:
        """The address of one number of a dense array: row · columns + column.  None where it is for Numba to find.

        Numba writes the whole array to memory first, and reads it back word by word.
        """
        array, kind = self.typeof(name), self.typeof(index)
        kinds = getattr(kind, "types", (kind,))
        dense = isinstance(array, types.Array) and array.layout == "C" and len(kinds) == array.ndim
        if not dense or not all(isinstance(one, types.Integer) for one in kinds):
            # Not a path that is missing: a kernel whose index counts from the end is refused when it is compiled.
            if any(getattr(one, "literal_value", 0) < 0 for one in getattr(kind, "types", ())):
                raise NotImplementedError(f"a block that counts from the end, {kind}; a kernel takes its row first")
            return None
        builder, model, value = self.builder, self.context.data_model_manager[array], self.loadvar(index)
        indices = [value] if kinds == (kind,) else cgutils.unpack_tuple(builder, value, len(kinds))
        value, shape = self.loadvar(name), model.get_field_position("shape")
        place = None
        for axis, (one, of) in enumerate(zip(indices, kinds, strict=True)):
            size = builder.extract_value(value, (shape, axis))
            number = self.context.cast(builder, one, of, types.intp)
            if getattr(of, "literal_value", 0) < 0 or (isinstance(one, ir.Constant) and one.constant < 0):
                number = builder.add(size, number)
            if self.context.enable_boundscheck:
                cgutils.do_boundscheck(self.context, builder, number, size, axis)
            place = number if place is None else builder.add(builder.mul(place, size), number)
        return builder.gep(model.get(builder, value, "data"), [place])


def _has_array(kind: Any) -> bool:
    """An index that has one makes a copy of what it looks at."""
    return isinstance(kind, types.Array) or any(map(_has_array, getattr(kind, "types", ())))


_count = NRTContext._call_incref_decref


def _count_owned(self: Any, builder: Any, typ: Any, value: Any, funcname: str) -> None:
    """One more or one less, unless the function has only borrowed arrays."""
    if not getattr(builder.module, "factorbus_borrows", False):
        _count(self, builder, typ, value, funcname)


_lower = BaseNativeLowering.run_pass


def _lower_for_kernels(self: Any, state: Any) -> bool:
    """Without what C would call it by, which nobody does in a process that compiles for others alone."""
    state.flags.no_cfunc_wrapper = True
    return _lower(self, state)


def _tell_nobody(kind: str, data: Any = None, exc_details: Any = None) -> None:
    """That a lock is taken, that LLVM is called: nobody listens in a process that compiles for others."""


_find_call_type = types.BaseFunction.get_call_type
_call_types: dict[int, tuple[Any, dict[Any, Any]]] = {}  # by the identity of the function, which is kept with them


def _known_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """What a built-in function comes to with such arguments.  Numba finds that out anew at every call, and in every
    round of its inference: a quarter of all the time that it takes to compile."""
    _, known = _call_types.setdefault(id(self), (self, {}))
    call = context, tuple(args), tuple(kws.items())
    if call not in known:
        known[call] = _find_call_type(self, context, args, kws)
    return known[call]


# The first two look at the module that they are called for, the third changes no code: Numba's own functions, which are
# compiled on the way and kept for others, come out as they always do.
_EXCHANGED = (
    (arrayobj, "fix_integer_index", _fix_integer_index),
    (NRTContext, "_call_incref_decref", _count_owned),
    (types.BaseFunction, "get_call_type", _known_call_type),
)
# In a process where Numba keeps nothing for others: all that it compiles is for kernels.
_EXCHANGED_APART = (
    *_EXCHANGED,
    (BaseNativeLowering, "run_pass", _lower_for_kernels),
    (event, "start_event", _tell_nobody),
    (event, "end_event", _tell_nobody),
)


@contextmanager
def changed_numba() -> Iterator[None]:
    """Numba with our functions in place of its own, which are back afterwards.  For who holds the compiler's lock."""
    exchanged = _EXCHANGED_APART if compiles_for_others() else _EXCHANGED
    found = [(owner, name, getattr(owner, name)) for owner, name, _ in exchanged]
    try:
        for owner, name, ours in exchanged:
            setattr(owner, name, ours)
        yield
    finally:
        for owner, name, theirs in found:
            setattr(owner, name, theirs)


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    _name = "borrowing_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return OurLower


class _PartLibrary(JITCodeLibrary):
    """The code of a part as it was written.  It is linked, optimized and made machine code in the kernels that call it.

    Numba's own libraries do all of that at every level of calls, and wrap each function for Python and for C.
    """

    def add_linking_library(self, library: Any) -> None:
        _add_linked(self._linking_libraries, library)

    def _optimize_functions(self, ll_module: Any) -> None:
        """Only what makes it smaller: the rest is done where it is linked."""
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = create_new_function_pass_manager(), self._codegen._pass_builder()
        passes.add_sroa_pass()
        passes.add_simplify_cfg_pass()
        passes.add_instruction_combine_pass()
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def finalize(self) -> None:
        self._finalized = True


class _KernelLibrary(JITCodeLibrary):
    """The code of a kernel and of all parts that it calls, directly or not."""

    def add_linking_library(self, library: Any) -> None:
        library._ensure_finalized()
        _add_linked(self._linking_libraries, library)

    def _optimize_functions(self, ll_module: Any) -> None:
        """That is done once they are all in one module."""
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """What the kernel calls is made its own first: nothing of another kernel is taken for it, whatever came before,
        and LLVM passes no argument that nobody reads.  An array is nine words of them, of which two or three are read.

        Numba runs cheap passes before, to see the counting of references in one function; here hardly any is left.
        And it has loops unrolled and interleaved: half as much code again, which no kernel is faster with.
        """
        for function in self._final_module.functions:
            if function.linkage == llvmlite.binding.Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = llvmlite.binding.Linkage.internal
        tuning = create_pipeline_tuning_options(_LEVEL)
        tuning.loop_unrolling = tuning.loop_interleaving = False
        builder = create_pass_builder(self._codegen._tm, tuning)
        passes = builder.getModulePassManager()
        passes.add_refprune_pass()
        passes.run(self._final_module, builder)

    def _get_module_for_linking(self) -> Any:
        """What is kept on disk beside the machine code, to be linked by others: nobody does, so only the names."""
        if self._shared_module is None:
            external = llvmlite.binding.Linkage.external
            names = [function.name for function in self.get_defined_functions() if function.linkage == external]
            text = "\n".join(f'define void @"{name}"() {{ ret void }}' for name in names)
            self._shared_module = llvmlite.binding.parse_assembly(text)
        return self._shared_module


def _add_linked(linked: list[Any], library: Any) -> None:
    """`library`, and what it links itself if it is a part's.  Callers stand before what they call: LLVM links only what
    it knows to be called."""
    for one in (library, *library._linking_libraries) if isinstance(library, _PartLibrary) else (library,):
        if one in linked:
            linked.remove(one)
        linked.append(one)


# Passes for what no kernel has: closures, `with`, `literal_unroll`, whole arrays in one expression and the like.  They
# changed none of all functions that were compiled.
_FOR_OTHERS = {
    "DumpParforDiagnostics",
    "FindLiterallyCalls",
    "InlineClosureLikes",
    "InlineInlinables",
    "InlineOverloads",
    "LiteralPropagationSubPipelinePass",
    "LiteralUnroll",
    "MakeFunctionToJitFunction",
    "NoPythonSupportedFeatureValidation",
    "NopythonRewrites",
    "RewriteDynamicRaises",
    "WithLifting",
}


class _Compiler(Compiler):
    """Numba's own compiler, with our lowering and without the passes that find nothing to do.

    The lifetimes of variables are worked out before types are found and before lowering, by the passes that need them,
    and not also after every other pass: the code is the same.
    """

    lowering = _Lowering

    def define_pipelines(self) -> list[Any]:
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [
                (self.lowering if one is NativeLowering else one, why)
                for one, why in pipeline.passes
                if one.__name__ not in _FOR_OTHERS
            ]
            pipeline.finalize()
            pipeline._ENFORCING = False
        return pipelines


class KernelCompiler(_Compiler):
    """The same with our library for a kernel."""

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Flags, names: Any
    ) -> None:
        if library is None:
            library = _KernelLibrary(targetctx.codegen(), "kernel")
            library.enable_object_caching()
        ours: Any = Flags(flags)
        ours.no_cfunc_wrapper = True  # nobody calls it from C
        super().__init__(typingctx, targetctx, library, args, return_type, ours, names)


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(_Lowering):
    """Lowering that ends with the code that others link."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        called_by = object()  # the name by which the code of others calls it
        state.cr = state.cr._replace(cfunc=called_by)
        state.targetctx.insert_user_function(called_by, state.cr.fndesc, [state.library])
        return True


class PartCompiler(_Compiler):
    lowering = _PartLowering

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Flags, names: Any
    ) -> None:
        library = library or _PartLibrary(targetctx.codegen(), "part")
        super().__init__(typingctx, targetctx, library, args, return_type, Flags(flags), names)
