"""Kernels that kernels call: they become parts of the kernels that Python calls.

Numba makes each function a program that Python can call. For each one it writes a wrapper,
optimises the function together with everything that it calls, makes machine code, and keeps a file.
A product kernel calls up to a hundred others, and nearly all of them are called by kernels only.

Here a kernel that is called by a kernel is a part: numba finds its types and writes its LLVM code,
once for each set of argument types. LLVM optimises a part only inside the kernels that Python
calls, which have all their parts in one module. A kernel is compiled with a wrapper when Python
calls it. `docs/compiled_kernels.md` has the measured times.

Source: numba/core/dispatcher.py and numba/core/codegen.py.
"""

import functools
from typing import Any

from rollerrig.rig.compiled import numba_import  # noqa: F401  the first import of numba
from rollerrig.rig.compiled.lazy_cache import LazyCache

# isort: split
from numba.core import codegen, compiler, dispatcher, errors, event, types, typing
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher
from numba.core.target_extension import dispatcher_registry, target_registry

# Steps of numba for what no kernel contains: closures, `with`, loops over tuples of several types,
# expressions of whole arrays, functions to inline at the level of Python
_FOR_OTHER_CODE = {
    "WithLifting",
    "InlineClosureLikes",
    "RewriteDynamicRaises",
    "MakeFunctionToJitFunction",
    "InlineInlinables",
    "FindLiterallyCalls",
    "LiteralUnroll",
    "LiteralPropagationSubPipelinePass",
    "InlineOverloads",
    "NopythonRewrites",
    "NoPythonSupportedFeatureValidation",
}

# numba's type of a value for its type of a constant
general_type = types.unliteral


class KernelPipeline(compiler.CompilerBase):  # type: ignore[misc]
    """Numba's steps from bytecode to LLVM code, without those that no kernel needs."""

    def define_pipelines(self) -> list[Any]:
        steps = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
        steps.passes = [step for step in steps.passes if step[0].__name__ not in _FOR_OTHER_CODE]
        return [steps]


class _PartCompiler(dispatcher._FunctionCompiler):  # type: ignore[misc, name-defined]
    """Numba's compiler of one function, up to the LLVM code."""

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = True
        # numba's name for a function of which it makes no machine code
        flags.no_compile = True
        return flags


class KernelDispatcher(CPUDispatcher):  # type: ignore[misc]
    """What `@kernel` makes of a function: Python and other kernels call it.

    Where Python calls it, it is compiled as numba compiles any function. Where another kernel calls
    it, it is a part of that kernel.
    """

    # of numba's base class, which has no published types
    _cache: Any
    _compiler: Any

    def __init__(
        self,
        py_func: Any,
        locals: Any = None,  # numba's name
        targetoptions: Any = None,
        pipeline_class: Any = Compiler,
    ) -> None:
        super().__init__(py_func, locals, targetoptions, pipeline_class)
        self._pipeline_class = pipeline_class
        # numba's results of compiling, by the types of the arguments
        self._parts: dict[tuple[Any, ...], Any] = {}

    def compile(self, sig: Any) -> Any:
        """Compile the kernel for a call by Python, or load it from the cache."""
        try:
            return super().compile(sig)
        finally:
            if isinstance(self._cache, LazyCache):
                self._cache.end_compiling()

    def get_call_template(self, args: Any, kws: Any) -> tuple[Any, ...]:
        """Return the signature of this kernel for a call by a kernel; compile it if necessary."""
        signature_in_python, given = self._compiler.fold_argument_types(args, kws)
        part = self._part(tuple(given))
        name = self.py_func.__name__
        template = typing.make_concrete_template(
            f"CallTemplate({name})", key=name, signatures=[part.signature]
        )
        return template, signature_in_python, given, {}

    def get_overload(self, sig: Any) -> Any:
        """Return the key under which numba finds the part for these argument types."""
        return self._part(tuple(sig)).fndesc

    def _part(self, given: tuple[Any, ...]) -> Any:
        """Return the part for arguments of these types; compile it at its first use."""
        if given not in self._parts:
            # one part serves calls with different constants
            general = tuple(general_type(kind) for kind in given)
            try:
                self._parts[given] = self._compiled_part(general)
            except errors.NumbaError:
                if given == general:
                    raise
                # the types of results, or of what it calls, depend on the constants
                self._parts[given] = self._compiled_part(given)
        return self._parts[given]

    def _compiled_part(self, given: tuple[Any, ...]) -> Any:
        if given in self._parts:
            return self._parts[given]
        details = {"dispatcher": self, "args": given, "return_type": None}
        with self._compiling_counter, event.trigger_event("numba:compile", data=details):
            try:
                part = self._part_compiler.compile(given, None)
            except errors.ForceLiteralArg as error:
                # numba asks the caller for the constants, whose types it then gives here
                raise error.bind_fold_arguments(self._folded) from error
        self.targetctx.insert_user_function(part.fndesc, part.fndesc, [part.library])
        self._parts[given] = part
        return part

    @functools.cached_property
    def _part_compiler(self) -> _PartCompiler:
        """The compiler of the parts; most programs load all entries, and need none."""
        return _PartCompiler(
            self.py_func, self.targetdescr, self.targetoptions, self.locals, self._pipeline_class
        )

    def _folded(self, args: Any, kws: Any) -> Any:
        """Return the types of all arguments, with those of defaults."""
        return self._compiler.fold_argument_types(args, kws)[1]


class _Library(codegen.JITCodeLibrary):  # type: ignore[misc]
    """The LLVM code of one function, and of all the functions that it calls.

    Numba optimises a library before it links it into another one. This class links it as it is.
    """

    def add_linking_library(self, library: Any) -> None:
        """Make this library link another one, and before it those that the other one links."""
        needed = [library]
        if not library._finalized:
            needed = [*library._linking_libraries, library]
        for other in needed:
            if other not in self._linking_libraries:
                self._linking_libraries.append(other)

    def finalize(self) -> None:
        """Link and optimise the library, and make its machine code."""
        # LLVM links a function only if the module already calls it: callers come first
        self._linking_libraries.reverse()
        super().finalize()

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM module of this library; that of a part is not optimised."""
        if self._shared_module is None and not self._finalized:
            # numba's method would optimise a library that is not final
            self._finalized = True
            try:
                return super()._get_module_for_linking()
            finally:
                self._finalized = False
        return self._shared_module or super()._get_module_for_linking()


codegen.JITCPUCodegen._library_class = _Library
# also for the functions in which numba implements Python's
dispatcher_registry.pop(target_registry["cpu"])
dispatcher_registry[target_registry["cpu"]] = KernelDispatcher
