"""Warp's CPU launches run their threads in a random order, or a part of them alone: a GPU keeps no order.

As a pytest plugin (`python -m pytest -p tests.thread_order`) it is for a process of its own: kernels that were compiled
before it is installed keep their order, and those compiled after it go to a cache of their own, since the order is no
part of the name by which Warp finds a compiled kernel again.
"""

import getpass
import hashlib
import tempfile
from pathlib import Path

import warp as wp
import warp._src.codegen as codegen

LOOP = "    for (size_t task_index = 0; task_index < dim->size; ++task_index)\n"
CALL = "_cpu_kernel_forward<wp_linear_contiguous>(*dim, task_index, _wp_args);"
PARTS = 32
"""A launch whose coord_mult is (n << PARTS) + k runs the k-th of n parts of its threads; Warp itself leaves it at 1."""

# a bijection of [0, n): Feistel rounds over the next power of four, walked until inside
TASK = """
static WP_FORCEINLINE size_t {name}_task(size_t i, size_t n)
{{
    unsigned half = 1;
    while (((size_t)1 << (2 * half)) < n) ++half;
    const size_t mask = ((size_t)1 << half) - 1;
    do {{
        size_t left = i >> half, right = i & mask;
        for (size_t round = 1; round <= 4; ++round) {{
            size_t mixed = (right + round * 104729) * (size_t)0x9E3779B97F4A7C15ull;
            mixed = (mixed ^ (mixed >> 29)) * (size_t)0xBF58476D1CE4E5B9ull;
            const size_t next = left ^ ((mixed >> 32) & mask);
            left = right;
            right = next;
        }}
        i = (left << half) | right;
    }} while (i >= n);
    return i;
}}
"""
RANGE = f"""    size_t begin = 0, end = dim->size;
    const size_t parts = dim->coord_mult >> {PARTS}, part = dim->coord_mult & (((size_t)1 << {PARTS}) - 1);
    if (parts) {{{{
        begin = dim->size * part / parts;
        end = dim->size * (part + 1) / parts;
        dim->coord_mult = 1;
    }}}}
    for (size_t task_index = begin; task_index < end; ++task_index)
"""


def install() -> None:
    """Changes the code that Warp writes around a kernel for the CPU."""
    text = codegen.cpu_module_template_forward
    assert text.count(LOOP) == text.count(CALL) == 1, "Warp writes another loop: adapt tests/thread_order.py"
    text = TASK + text.replace(LOOP, RANGE).replace(
        CALL, CALL.replace("task_index", "{name}_task(task_index, dim->size)")
    )
    codegen.cpu_module_template_forward = text
    digest = hashlib.sha256(text.encode()).hexdigest()[:8]
    wp.config.kernel_cache_dir = str(Path(tempfile.gettempdir()) / f"hvnet-threads-{getpass.getuser()}-{digest}")


def pytest_configure() -> None:
    """The plugin."""
    install()
