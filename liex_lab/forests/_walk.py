"""SIMD descent of regression trees, sixteen samples at once: the fast version of
`_kernels.descend`.

A test has no branch here: both probes are read, and the node's kind selects the result. That alone
is twice as fast as branching, which the processor cannot predict; sixteen lanes make it about six
times as fast. Numba does not vectorise such a loop by itself, so its body is written as LLVM's
portable intermediate code, which runs on any processor with its own vector width. Arithmetic is
float32 in the order of `_kernels.probe`, so that the answers are identical.

Lanes read from flat arrays. `pixels` int16 contains height maps, followed by the samples' scalars,
rounded down (a threshold is an integer, so rounding down changes no answer); `base` int32 (n,) is
the start of a sample's map in it, `scalar_base` int32 (n,) the start of its scalars. n is a
multiple of LANES; lanes without a sample may contain zeros.
"""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from liex_lab.forests._kernels import ONE_PROBE, SCALAR, VIEW

LANES = 16
_INTS = f"<{LANES} x i32>"
_FLOATS = f"<{LANES} x float>"
_BITS = f"<{LANES} x i1>"


def _same(type_: str, value: object) -> str:
    """A vector constant with one value in all lanes."""
    return "<" + ", ".join([f"{type_} {value}"] * LANES) + ">"


def _mask(indices: list[int]) -> str:
    """A shuffle mask of the given indices, as LLVM text."""
    return f"<{len(indices)} x i32> <" + ", ".join(f"i32 {i}" for i in indices) + ">"


class _Text:
    """LLVM code under construction; a call appends one line."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def __call__(self, line: str) -> None:
        self.lines.append("  " + line)

    def spread(self, name: str, type_: str, value: str) -> None:
        """A scalar in all lanes of %name."""
        vector = _INTS if type_ == "i32" else _FLOATS
        self(f"%{name}.one = insertelement {vector} undef, {type_} {value}, i32 0")
        self(
            f"%{name} = shufflevector {vector} %{name}.one, {vector} undef, <{LANES} x i32> "
            "zeroinitializer"
        )

    def joined(self, names: list[str], type_: str, width: int) -> list[str]:
        """The rows %names of `width` elements each, joined two by two until rows are LANES or more
        long.
        """
        while width < LANES:
            pairs = [f"{names[i]}.{width}" for i in range(0, len(names), 2)]
            for i, pair in enumerate(pairs):
                first = names[2 * i]
                second = names[2 * i + 1]
                self(
                    f"%{pair} = shufflevector <{width} x {type_}> %{first}, <{width} x {type_}> "
                    f"%{second}, {_mask(list(range(2 * width)))}"
                )
            names = pairs
            width = 2 * width
        return names

    def column(self, name: str, rows: list[str], type_: str, width: int, index: int) -> None:
        """%name: element `index` of every lane's record, from rows of LANES / width records of that
        width each.
        """
        each = LANES // width
        parts = []
        for i in range(0, len(rows), 2):
            part = f"{name}.p{i}"
            picked = [width * r + index for r in range(each)]
            self(
                f"%{part} = shufflevector <{LANES} x {type_}> %{rows[i]}, <{LANES} x {type_}> "
                f"%{rows[i + 1]}, {_mask(picked + [LANES + p for p in picked])}"
            )
            parts.append(part)
        last = self.joined(parts, type_, 2 * each)[0]
        self(f"%{name} = bitcast <{LANES} x {type_}> %{last} to <{LANES} x {type_}>")

    def signed_byte(self, name: str, word: str, index: int) -> None:
        """%name: byte `index` of the word, as float."""
        if index < 3:
            self(f"%{name}.up = shl {_INTS} %{word}, {_same('i32', 24 - 8 * index)}")
        source = f"{name}.up" if index < 3 else word
        self(f"%{name}.int = ashr {_INTS} %{source}, {_same('i32', 24)}")
        self(f"%{name} = sitofp {_INTS} %{name}.int to {_FLOATS}")

    def pixel_of(self, name: str, offsets: list[str]) -> None:
        """%name: index in `pixels` of the probe under an offset."""
        for axis, start, first in (("column", "middle_u", 2), ("row", "middle_v", 5)):
            total = start
            for i, offset in enumerate(offsets):
                self(f"%{name}.{axis}.m{i} = fmul {_FLOATS} %view{first + i}, %{offset}")
                self(f"%{name}.{axis}.s{i} = fadd {_FLOATS} %{total}, %{name}.{axis}.m{i}")
                total = f"{name}.{axis}.s{i}"
            self(f"%{name}.{axis}.int = fptosi {_FLOATS} %{total} to {_INTS}")
            self(
                f"%{name}.{axis}.low = call {_INTS} @llvm.smax.v{LANES}i32({_INTS} "
                f"%{name}.{axis}.int, {_INTS} zeroinitializer)"
            )
            self(
                f"%{name}.{axis} = call {_INTS} @llvm.smin.v{LANES}i32({_INTS} %{name}.{axis}.low, "
                f"{_INTS} %limit)"
            )
        self(f"%{name}.line = mul {_INTS} %{name}.row, %sides")
        self(f"%{name}.in = add {_INTS} %{name}.line, %{name}.column")
        self(f"%{name} = add {_INTS} %{name}.in, %map")

    def read(self, name: str, index: str) -> None:
        """%name: the pixels at an index, as float. One by one, as gathers are no faster and rarely
        available.
        """
        before = "undef"
        for k in range(LANES):
            self(f"%{name}.i{k} = extractelement {_INTS} %{index}, i32 {k}")
            self(f"%{name}.w{k} = zext i32 %{name}.i{k} to i64")
            self(f"%{name}.a{k} = getelementptr i16, ptr %pixels, i64 %{name}.w{k}")
            self(f"%{name}.v{k} = load i16, ptr %{name}.a{k}, align 2")
            self(
                f"%{name}.r{k} = insertelement <{LANES} x i16> {before}, i16 %{name}.v{k}, i32 {k}"
            )
            before = f"%{name}.r{k}"
        self(f"%{name}.int = sext <{LANES} x i16> {before} to {_INTS}")
        self(f"%{name} = sitofp {_INTS} %{name}.int to {_FLOATS}")


def _load_nodes(text: _Text) -> None:
    """%word0 .. %word3 of each lane's node."""
    for k in range(LANES):
        text(f"%at{k} = extractelement {_INTS} %at, i32 {k}")
        text(f"%wide{k} = zext i32 %at{k} to i64")
        text(f"%where{k} = getelementptr <4 x i32>, ptr %nodes, i64 %wide{k}")
        text(f"%node{k} = load <4 x i32>, ptr %where{k}, align 4")
    rows = text.joined([f"node{k}" for k in range(LANES)], "i32", 4)
    for word in range(4):
        text.column(f"word{word}", rows, "i32", 4, word)


def _load_view(text: _Text) -> None:
    """%view0 .. %view8 of the only view: views (9, n), read in place."""
    for c in range(VIEW):
        text(f"%skip{c} = mul i64 %stride, {c}")
        text(f"%spot{c} = add i64 %skip{c}, %first")
        text(f"%from{c} = getelementptr float, ptr %views, i64 %spot{c}")
        text(f"%view{c} = load {_FLOATS}, ptr %from{c}, align 4")


def _load_views(text: _Text) -> None:
    """%view0 .. %view8 of the view selected by each lane's node: views (n, V, 9)."""
    text(f"%channel.view = select {_BITS} %is_scalar, {_INTS} zeroinitializer, {_INTS} %channel")
    before = "undef"
    for k in range(LANES):
        text(f"%ch{k} = extractelement {_INTS} %channel.view, i32 {k}")
        text(f"%chw{k} = zext i32 %ch{k} to i64")
        text(f"%chs{k} = mul i64 %chw{k}, {VIEW}")
        text(f"%lane{k} = add i64 %first, {k}")
        text(f"%own{k} = mul i64 %lane{k}, %stride")
        text(f"%begin{k} = add i64 %own{k}, %chs{k}")
        text(f"%from{k} = getelementptr float, ptr %views, i64 %begin{k}")
        text(f"%eight{k} = load <8 x float>, ptr %from{k}, align 4")
        text(f"%ninth{k} = getelementptr float, ptr %from{k}, i64 8")
        text(f"%high{k} = load float, ptr %ninth{k}, align 4")
        text(f"%highs{k} = insertelement {_FLOATS} {before}, float %high{k}, i32 {k}")
        before = f"%highs{k}"
    rows = text.joined([f"eight{k}" for k in range(LANES)], "float", 8)
    for c in range(8):
        text.column(f"view{c}", rows, "float", 8, c)
    text(f"%view8 = fadd {_FLOATS} {before}, {_same('float', '-0.0')}")


def _middle(text: _Text) -> None:
    """%middle_u and %middle_v: the joint's crop pixel plus one half, for rounding."""
    for c, axis in ((0, "u"), (1, "v")):
        text(f"%middle_{axis} = fadd {_FLOATS} %view{c}, {_same('float', '0.5')}")


def llvm_text(name: str, multi_view: bool) -> str:
    """The descent as an LLVM module in text form.

    Args:
        name: name of the function to define.
        multi_view: nodes choose among the samples' views (n, V, 9); otherwise each sample has one
            view, laid out (9, n).

    Returns:
        The module's text, with one function that `_emit` links and calls.
    """
    text = _Text()
    text.spread("start", "i32", "%root")
    text.spread("sides", "i32", "%side")
    text("%last = sub i32 %side, 1")
    text.spread("limit", "i32", "%last")
    for vector, pointer, type_ in (
        ("map", "base", _INTS),
        ("own", "scalar_base", _INTS),
        ("inv", "inverse", _FLOATS),
    ):
        text(f"%{vector}.p = getelementptr i32, ptr %{pointer}, i64 %first")
        text(f"%{vector} = load {type_}, ptr %{vector}.p, align 4")
    if not multi_view:
        _load_view(text)
        _middle(text)
    text("br label %loop")
    text.lines.append("loop:")
    text(f"%at = phi {_INTS} [%start, %entry], [%next, %loop]")
    _load_nodes(text)
    text(f"%kind = and {_INTS} %word3, {_same('i32', 3)}")
    text(f"%channel = ashr {_INTS} %word3, {_same('i32', 2)}")
    text(f"%is_one = icmp eq {_INTS} %kind, {_same('i32', ONE_PROBE)}")
    text(f"%is_scalar = icmp eq {_INTS} %kind, {_same('i32', SCALAR)}")
    if multi_view:
        _load_views(text)
        _middle(text)
    for offset, word, byte in (
        ("u0", 0, 0),
        ("u1", 0, 1),
        ("u2", 0, 2),
        ("v0", 0, 3),
        ("v1", 1, 0),
        ("v2", 1, 1),
    ):
        text.signed_byte(offset, f"word{word}", byte)
    text.pixel_of("under_u", ["u0", "u1", "u2"])
    text.pixel_of("under_v", ["v0", "v1", "v2"])
    text(f"%scalar = add {_INTS} %own, %channel")
    text(f"%place = select {_BITS} %is_scalar, {_INTS} %scalar, {_INTS} %under_u")
    text.read("a", "place")
    text.read("b", "under_v")
    text(f"%height = fmul {_FLOATS} %a, %inv")
    text(f"%other = fmul {_FLOATS} %b, %inv")
    text(f"%less = select {_BITS} %is_one, {_FLOATS} %view8, {_FLOATS} %other")
    text(f"%difference = fsub {_FLOATS} %height, %less")
    text(f"%value = select {_BITS} %is_scalar, {_FLOATS} %a, {_FLOATS} %difference")
    text(f"%level = ashr {_INTS} %word1, {_same('i32', 16)}")
    text(f"%threshold = sitofp {_INTS} %level to {_FLOATS}")
    text(f"%right = fcmp oge {_FLOATS} %value, %threshold")
    text(f"%step = zext {_BITS} %right to {_INTS}")
    text(f"%child = add {_INTS} %word2, %step")
    text(f"%inner = icmp sge {_INTS} %word2, zeroinitializer")
    text(f"%next = select {_BITS} %inner, {_INTS} %child, {_INTS} %at")
    text(f"%more = call i1 @llvm.vector.reduce.or.v{LANES}i1({_BITS} %inner)")
    text("br i1 %more, label %loop, label %done")
    text.lines.append("done:")
    text(f"%leaves = xor {_INTS} %word2, {_same('i32', -1)}")
    text("%out = getelementptr i32, ptr %leaf, i64 %first")
    text(f"store {_INTS} %leaves, ptr %out, align 4")
    text("ret void")
    pointers = ", ".join(
        f"ptr noalias %{name}" for name in ("pixels", "base", "scalar_base", "inverse", "views")
    )
    return "\n".join(
        [
            f"declare {_INTS} @llvm.smin.v{LANES}i32({_INTS}, {_INTS})",
            f"declare {_INTS} @llvm.smax.v{LANES}i32({_INTS}, {_INTS})",
            f"declare i1 @llvm.vector.reduce.or.v{LANES}i1({_BITS})",
            f"define weak_odr void @{name}(ptr noalias %nodes, i32 %root, {pointers}, i64 "
            "%stride, i32 %side, ptr noalias %leaf, i64 %first) noinline {",
            "entry:",
            *text.lines,
            "}",
        ]
    )


def _emit(name: str, multi_view: bool) -> Any:
    """The code generator of an intrinsic that links and calls the function of `llvm_text`."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        library = context.codegen().create_library(name)
        library.add_llvm_module(llvm.parse_assembly(llvm_text(name, multi_view)))
        library.finalize()
        context.active_code_library.add_linking_library(library)
        pointer = ir.IntType(8).as_pointer()
        i32 = ir.IntType(32)
        i64 = ir.IntType(64)
        expected = [pointer, i32, *[pointer] * 5, i64, i32, pointer, i64]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), expected), name
        )
        values = []
        for value, kind, kind_out in zip(args, signature.args, expected, strict=True):
            if isinstance(kind, types.Array):
                value = builder.bitcast(
                    context.make_array(kind)(context, builder, value).data, pointer
                )
            elif value.type.width != kind_out.width:
                value = (
                    builder.trunc(value, kind_out)
                    if value.type.width > kind_out.width
                    else builder.sext(value, kind_out)
                )
            values.append(value)
        builder.call(function, values)
        return context.get_dummy_value()

    return codegen


@intrinsic
def walk_one_view(
    typing: Any,
    nodes: Any,
    root: Any,
    pixels: Any,
    base: Any,
    scalar_base: Any,
    inverse: Any,
    views: Any,
    stride: Any,
    side: Any,
    leaf: Any,
    first: Any,
) -> Any:
    """Descend one tree with LANES samples of one view each.

    Arrays are contiguous; nothing is checked.

    Args:
        typing: numba's typing context.
        nodes: (N, 4) int32 packed nodes, see `_kernels`.
        root: index of the tree's root.
        pixels: int16 height maps, followed by the samples' scalars.
        base: (n,) int32 start of each sample's height map in pixels.
        scalar_base: (n,) int32 start of each sample's scalars in pixels.
        inverse: (n,) float32 home size over the animal's size.
        views: (9, n) float32 linearised projections.
        stride: n, the length of a row of views.
        side: side of the height maps, pixels.
        leaf: (n,) int32; lanes first .. first + LANES - 1 are filled with the leaf they reach.
        first: the first of the LANES lanes.
    """
    arguments = (nodes, root, pixels, base, scalar_base, inverse, views, stride, side, leaf, first)
    return types.void(*arguments), _emit("liex_walk_one_view", False)


@intrinsic
def walk_views(
    typing: Any,
    nodes: Any,
    root: Any,
    pixels: Any,
    base: Any,
    scalar_base: Any,
    inverse: Any,
    views: Any,
    stride: Any,
    side: Any,
    leaf: Any,
    first: Any,
) -> Any:
    """Descend one tree with LANES samples, whose nodes choose among multiple views of a sample.

    Arrays are contiguous; nothing is checked.

    Args:
        typing: numba's typing context.
        nodes: (N, 4) int32 packed nodes, see `_kernels`.
        root: index of the tree's root.
        pixels: int16 height maps, followed by the samples' scalars.
        base: (n,) int32 start of each sample's height map in pixels.
        scalar_base: (n,) int32 start of each sample's scalars in pixels.
        inverse: (n,) float32 home size over the animal's size.
        views: (n, V, 9) float32 linearised projections.
        stride: 9 V, the length of a sample's views.
        side: side of the height maps, pixels.
        leaf: (n,) int32; lanes first .. first + LANES - 1 are filled with the leaf they reach.
        first: the first of the LANES lanes.
    """
    arguments = (nodes, root, pixels, base, scalar_base, inverse, views, stride, side, leaf, first)
    return types.void(*arguments), _emit("liex_walk_views", True)
