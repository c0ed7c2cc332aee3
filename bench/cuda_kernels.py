"""Every kernel of `hvnet.kernels`, compiled for GPUs on a machine without one: registers, stack, what its loops load.

Nothing here is a list of kernels: a module that is added, and a factory in it, are found.
"""

import ast
import functools
import importlib
import inspect
import itertools
import pkgutil
import re
import shutil
import subprocess
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
import warp as wp

import hvnet.kernels
from hvnet.kernels.launch import WARP_FLOAT, lanes_of, start

PIP = "pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm"
CUDA = torch.device("cuda")
DOMAINS: dict[str, Sequence[Any]] = {
    "dtype": tuple(WARP_FLOAT.values()),
    "lanes": tuple({lanes_of(count, CUDA) for count in (1, 4, 16, 64, 128)}),
    "image_dtype": (wp.float32, wp.float16, wp.bfloat16),
    "map_dtype": (wp.float32, wp.float16, wp.bfloat16),
}
"""What the parameters of the functions that make kernels can be, on a GPU."""
STACK_OF = {"sin": 32, "cos": 32, "mesh_query_ray": 320}
"""Bytes of stack that functions of CUDA and Warp take by themselves: sine and cosine only for angles beyond 10^5."""
MAX_REGISTERS = 96
"""Of a thread: with more, fewer than a third of the threads that a multiprocessor can hold find room."""


class Found(NamedTuple):
    """A kernel, and the parameters of the function that made it."""

    name: str  # module.function
    kernel: wp.Kernel
    parameters: dict[str, Any]

    @property
    def dtype(self) -> str | None:
        """The floating type that it is made for; None: for no particular one."""
        return next((value.__name__ for value in self.parameters.values() if isinstance(value, type)), None)

    @property
    def lanes(self) -> int:
        """Channels that a thread takes."""
        return self.parameters.get("lanes", 1)

    @property
    def symbol(self) -> str:
        """Its name in compiled code."""
        return f"{self.kernel.get_mangled_name()}_cuda_kernel_forward"

    def __str__(self) -> str:
        given = (str(getattr(value, "__name__", value)) for value in self.parameters.values())
        return f"{self.name}[{', '.join(given)}]" if self.parameters else self.name


class Usage(NamedTuple):
    """What a thread of a kernel takes, bytes but for the registers."""

    registers: int
    stack: int
    shared: int
    local: int


class Code(NamedTuple):
    """What a kernel's instructions do, counted by bytes a thread: {16: 2} is two of 16 bytes."""

    spill_stores: int  # bytes
    spill_loads: int  # bytes
    loads: Counter[int]  # from global memory in the innermost loop
    stores: Counter[int]
    loops: bool  # False: there is no loop, and loads and stores are those of the whole kernel


def name_of(kernel: wp.Kernel) -> str:
    """module.function of a kernel."""
    return f"{kernel.func.__module__.removeprefix('hvnet.kernels.')}.{kernel.func.__name__}"


def find_kernels() -> list[Found]:
    """Every kernel of the package, those that functions make once for each value of the parameters.

    Raises TypeError if the values of a parameter are not known.
    """
    start()
    found: dict[int, Found] = {}
    for info in pkgutil.iter_modules(hvnet.kernels.__path__):
        module = importlib.import_module(f"hvnet.kernels.{info.name}")
        for value in vars(module).values():
            if getattr(value, "__module__", None) not in (module.__name__, None):
                continue  # imported from another module, which is looked through as well
            for kernel, parameters in made_kernels(value):
                found.setdefault(id(kernel), Found(name_of(kernel), kernel, parameters))
    return list(found.values())


def made_kernels(value: object) -> Iterator[tuple[wp.Kernel, dict[str, Any]]]:
    """The kernels that a module's attribute is or, if it is a cached function with kernels in it, makes."""
    if isinstance(value, wp.Kernel):
        yield value, {}
    elif hasattr(value, "cache_info") and kernel_names(inspect.getsource(inspect.unwrap(value))):  # type: ignore[arg-type]
        names = tuple(inspect.signature(value).parameters)  # type: ignore[arg-type]
        unknown = [name for name in names if name not in DOMAINS]
        if unknown:
            where = f"{value.__module__}.{value.__qualname__}"  # type: ignore[attr-defined]
            raise TypeError(f"{where}: what {', '.join(unknown)} can be is not known: add it to cuda_kernels.DOMAINS")
        for values in itertools.product(*(DOMAINS[name] for name in names)):
            for kernel in kernels_in(value(*values)):  # type: ignore[operator]
                yield kernel, dict(zip(names, values, strict=True))


def kernels_in(made: object) -> list[wp.Kernel]:
    """The kernels of what a function has made: one, a tuple, or a namespace."""
    if isinstance(made, wp.Kernel):
        return [made]
    values = made if isinstance(made, tuple) else vars(made).values()
    return [value for value in values if isinstance(value, wp.Kernel)]


def kernel_names(source: str) -> set[str]:
    """The names of all functions in a source text that are decorated with wp.kernel."""
    return {
        node.name
        for node in ast.walk(ast.parse(textwrap.dedent(source)))
        if isinstance(node, ast.FunctionDef)
        and any(ast.unparse(each).partition("(")[0] == "wp.kernel" for each in node.decorator_list)
    }


def written_kernels() -> set[str]:
    """module.function of every kernel in the package's files."""
    (folder,) = hvnet.kernels.__path__
    files = sorted(Path(folder).glob("*.py"))
    return {f"{file.stem}.{name}" for file in files for name in kernel_names(file.read_text(encoding="utf-8"))}


def builtins_of(kernel: wp.Kernel) -> set[str]:
    """The names of what a kernel's source, and that of every wp.func that it names, takes from Warp."""
    names: set[str] = set()
    seen, todo = set(), [kernel.func]
    while todo:
        function = todo.pop()
        if function in seen:
            continue
        seen.add(function)
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
        names |= {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        known = inspect.getclosurevars(function)
        named = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
        values = [{**known.globals, **known.nonlocals}.get(name) for name in named]
        todo += [value.func for value in values if isinstance(value, wp.Function) and value.func is not None]
    return names


def uses_atomics(kernel: wp.Kernel) -> bool:
    """Whether a kernel has an atomic operation, so that what one thread reads may depend on another."""
    return any(name.startswith("atomic_") for name in builtins_of(kernel))


def compile_kernels(kernels: Sequence[wp.Kernel], archs: Sequence[int], folder: Path) -> dict[int, list[Path]]:
    """Compiles the modules of the kernels to CUBIN files in a folder, by architecture (90 is sm_90)."""
    start()
    files: dict[int, list[Path]] = {arch: [] for arch in archs}
    for module in dict.fromkeys(kernel.module for kernel in kernels):
        written = wp.compile_aot_module(module, arch=list(archs), module_dir=folder, use_ptx=False)
        for arch, file in zip(archs, written, strict=True):
            files[arch].append(file)
    return files


@functools.cache
def tool(name: str) -> Path | None:
    """A program of the CUDA toolkit: on the path, or from NVIDIA's packages on PyPI."""
    on_path = shutil.which(name)
    if on_path:
        return Path(on_path)
    try:
        packages = importlib.import_module("nvidia").__path__
    except ImportError:
        return None
    return next((file for root in packages for file in Path(root).glob(f"*/bin/{name}")), None)


def run_tool(name: str, *arguments: str | Path) -> str:
    """What a program of the CUDA toolkit prints. Raises FileNotFoundError where there is none."""
    program = tool(name)
    if program is None:
        raise FileNotFoundError(f"{name} is missing: {PIP}")
    return subprocess.run([program, *arguments], capture_output=True, text=True, check=True).stdout


def resources(cubin: Path) -> dict[str, Usage]:
    """What the kernels of a CUBIN file take, by symbol."""
    text = run_tool("cuobjdump", "--dump-resource-usage", cubin)
    pattern = r"Function (\S+):\s+REG:(\d+) STACK:(\d+) SHARED:(\d+) LOCAL:(\d+)"
    return {match[1]: Usage(*(int(value) for value in match.groups()[1:])) for match in re.finditer(pattern, text)}


def code_of(cubin: Path) -> dict[str, Code]:
    """What the instructions of the kernels of a CUBIN file do, by symbol."""
    text = run_tool("nvdisasm", "-c", cubin)
    parts = re.split(r"^//-+ \.text\.", text, flags=re.MULTILINE)[1:]
    return {part.split()[0]: read_code(part) for part in parts}


def read_code(text: str) -> Code:
    """The `Code` of the lines that nvdisasm prints for a kernel.

    A loop is what lies between a label and a branch back to it; it is an innermost one if no other loop lies inside.
    Of several innermost ones that with the most loads from global memory counts. All copies that the compiler made of
    a loop's body count.
    """
    instructions: list[str] = []
    labels: dict[str, int] = {}
    loops: list[tuple[int, int]] = []
    for line in text.splitlines():
        if label := re.match(r"(\.L\w+):", line):
            labels[label[1]] = len(instructions)
        elif found := re.match(r"\s+/\*[0-9a-f]+\*/\s+(?:@!?U?P\w+\s+)?([A-Z].*?)\s*;", line):
            back = re.match(r"BRA.*`\((\.L\w+)\)", found[1])
            if back and labels.get(back[1], len(instructions)) < len(instructions):
                loops.append((labels[back[1]], len(instructions)))
            instructions.append(found[1])

    def count(base: str, begin: int, end: int) -> Counter[int]:
        names = [each.split()[0] for each in instructions[begin : end + 1]]
        return Counter(width_of(name) for name in names if name.split(".")[0] == base)

    def total(base: str) -> int:
        return sum(width * number for width, number in count(base, 0, len(instructions)).items())

    innermost = [(a, b) for a, b in loops if not any((c, d) != (a, b) and a <= c and d <= b for c, d in loops)]
    begin, end = max(innermost, key=lambda loop: count("LDG", *loop).total(), default=(0, len(instructions)))
    return Code(total("STL"), total("LDL"), count("LDG", begin, end), count("STG", begin, end), bool(loops))


def width_of(instruction: str) -> int:
    """Bytes that a load or store moves: LDG.E.128 is 16, LDG.E.U16 2, LDG.E 4."""
    sizes = {"8": 1, "16": 2, "32": 4, "64": 8, "128": 16, "256": 32}
    found = (re.fullmatch(r"[US]?(\d+)", part) for part in instruction.split(".")[1:])
    return next((sizes[match[1]] for match in found if match and match[1] in sizes), 4)


def resource_faults(found: Sequence[Found], archs: Sequence[int], folder: Path) -> list[str]:
    """The kernels, but for those of float64, that spill, have an array of their own or too many registers.

    One a line; also kernels that the compiled files in the folder do not have. What CUDA's and Warp's own functions put
    on the stack does not count. Kernels of float64 are compiled for the first architecture alone: that they compile.
    """
    faults = []
    counted = [each for each in found if each.dtype != "float64"]
    for arch in archs:
        wanted = found if arch == archs[0] else counted
        usage: dict[str, Usage] = {}
        for file in compile_kernels([each.kernel for each in wanted], [arch], folder)[arch]:
            usage |= resources(file)
        faults += [f"sm_{arch} {each}: is not in its module's file" for each in wanted if each.symbol not in usage]
        for each in counted:
            if use := usage.get(each.symbol):
                own = use.stack - max((STACK_OF.get(name, 0) for name in builtins_of(each.kernel)), default=0)
                if own > 0 or use.local or use.registers > MAX_REGISTERS:
                    faults.append(f"sm_{arch} {each}: {use.registers} registers, stack {use.stack}, local {use.local}")
    return faults
