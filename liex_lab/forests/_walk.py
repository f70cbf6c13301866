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


_ZEROS = f"<{LANES} x i32> zeroinitializer"
_SMIN = f"@llvm.smin.v{LANES}i32"
_SMAX = f"@llvm.smax.v{LANES}i32"
_ANY = f"@llvm.vector.reduce.or.v{LANES}i1"
# the joint's crop pixel plus one half, for rounding
_MIDDLE = f"""
    %middle_u = fadd {_FLOATS} %view0, {_same("float", "0.5")}
    %middle_v = fadd {_FLOATS} %view1, {_same("float", "0.5")}
"""
_FUNCTION = f"""
declare {_INTS} {_SMIN}({_INTS}, {_INTS})
declare {_INTS} {_SMAX}({_INTS}, {_INTS})
declare i1 {_ANY}({_BITS})
define weak_odr void @{{name}}(ptr noalias %nodes, i32 %root, ptr noalias %pixels,
    ptr noalias %base, ptr noalias %scalar_base, ptr noalias %inverse, ptr noalias %views,
    i64 %stride, i32 %side, ptr noalias %leaf, i64 %first) noinline {{{{
entry:
{{body}}
done:
  %leaves = xor {_INTS} %word2, {_same("i32", -1)}
  %out = getelementptr i32, ptr %leaf, i64 %first
  store {_INTS} %leaves, ptr %out, align 4
  ret void
}}}}
"""


class _Text:
    """LLVM code under construction; a call appends lines."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def __call__(self, block: str) -> None:
        self.lines += ["  " + line.strip() for line in block.strip().splitlines()]

    def spread(self, name: str, type_: str, value: str) -> None:
        """A scalar in all lanes of %name."""
        vector = _INTS if type_ == "i32" else _FLOATS
        self(f"""
            %{name}.one = insertelement {vector} undef, {type_} {value}, i32 0
            %{name} = shufflevector {vector} %{name}.one, {vector} undef, {_ZEROS}
        """)

    def joined(self, names: list[str], type_: str, width: int) -> list[str]:
        """The rows %names of `width` elements each, joined two by two until rows are LANES or more
        elements wide.
        """
        while width < LANES:
            pairs = []
            row = f"<{width} x {type_}>"
            mask = _mask(list(range(2 * width)))
            for first, second in zip(names[::2], names[1::2], strict=True):
                pairs.append(f"{first}.{width}")
                self(f"%{pairs[-1]} = shufflevector {row} %{first}, {row} %{second}, {mask}")
            names = pairs
            width = 2 * width
        return names

    def column(self, name: str, rows: list[str], type_: str, width: int, index: int) -> None:
        """%name: element `index` of every lane's record, from rows of LANES / width records of that
        width.
        """
        each = LANES // width
        vector = f"<{LANES} x {type_}>"
        picked = [width * r + index for r in range(each)]
        mask = _mask(picked + [LANES + p for p in picked])
        parts = []
        for i in range(0, len(rows), 2):
            parts.append(f"{name}.p{i}")
            self(
                f"%{parts[-1]} = shufflevector {vector} %{rows[i]}, {vector} %{rows[i + 1]}, {mask}"
            )
        last = self.joined(parts, type_, 2 * each)[0]
        self(f"%{name} = bitcast {vector} %{last} to {vector}")

    def signed_byte(self, name: str, word: str, index: int) -> None:
        """%name: byte `index` of the word, as float."""
        self(f"""
            %{name}.up = shl {_INTS} %{word}, {_same("i32", 24 - 8 * index)}
            %{name}.int = ashr {_INTS} %{name}.up, {_same("i32", 24)}
            %{name} = sitofp {_INTS} %{name}.int to {_FLOATS}
        """)

    def pixel_of(self, name: str, offsets: list[str]) -> None:
        """%name: index in `pixels` of the probe under an offset."""
        for axis, start, first in (("column", "middle_u", 2), ("row", "middle_v", 5)):
            at = f"{name}.{axis}"
            total = start
            for i, offset in enumerate(offsets):
                self(f"""
                    %{at}.m{i} = fmul {_FLOATS} %view{first + i}, %{offset}
                    %{at}.s{i} = fadd {_FLOATS} %{total}, %{at}.m{i}
                """)
                total = f"{at}.s{i}"
            self(f"""
                %{at}.int = fptosi {_FLOATS} %{total} to {_INTS}
                %{at}.low = call {_INTS} {_SMAX}({_INTS} %{at}.int, {_INTS} zeroinitializer)
                %{at} = call {_INTS} {_SMIN}({_INTS} %{at}.low, {_INTS} %limit)
            """)
        self(f"""
            %{name}.line = mul {_INTS} %{name}.row, %sides
            %{name}.in = add {_INTS} %{name}.line, %{name}.column
            %{name} = add {_INTS} %{name}.in, %map
        """)

    def read(self, name: str, index: str) -> None:
        """%name: the pixels at an index, as float. One by one, as gathers are no faster and rarely
        available.
        """
        shorts = f"<{LANES} x i16>"
        before = "undef"
        for k in range(LANES):
            self(f"""
                %{name}.i{k} = extractelement {_INTS} %{index}, i32 {k}
                %{name}.w{k} = zext i32 %{name}.i{k} to i64
                %{name}.a{k} = getelementptr i16, ptr %pixels, i64 %{name}.w{k}
                %{name}.v{k} = load i16, ptr %{name}.a{k}, align 2
                %{name}.r{k} = insertelement {shorts} {before}, i16 %{name}.v{k}, i32 {k}
            """)
            before = f"%{name}.r{k}"
        self(f"""
            %{name}.int = sext {shorts} {before} to {_INTS}
            %{name} = sitofp {_INTS} %{name}.int to {_FLOATS}
        """)


def _load_nodes(text: _Text) -> None:
    """%word0 .. %word3 of each lane's node."""
    for k in range(LANES):
        text(f"""
            %at{k} = extractelement {_INTS} %at, i32 {k}
            %wide{k} = zext i32 %at{k} to i64
            %where{k} = getelementptr <4 x i32>, ptr %nodes, i64 %wide{k}
            %node{k} = load <4 x i32>, ptr %where{k}, align 4
        """)
    rows = text.joined([f"node{k}" for k in range(LANES)], "i32", 4)
    for word in range(4):
        text.column(f"word{word}", rows, "i32", 4, word)


def _load_view(text: _Text) -> None:
    """%view0 .. %view8 of the only view: views (9, n), read in place."""
    for c in range(VIEW):
        text(f"""
            %skip{c} = mul i64 %stride, {c}
            %spot{c} = add i64 %skip{c}, %first
            %from{c} = getelementptr float, ptr %views, i64 %spot{c}
            %view{c} = load {_FLOATS}, ptr %from{c}, align 4
        """)
    text(_MIDDLE)


def _load_views(text: _Text) -> None:
    """%view0 .. %view8 of the view selected by each lane's node: views (n, V, 9)."""
    text(f"%channel.view = select {_BITS} %is_scalar, {_INTS} zeroinitializer, {_INTS} %channel")
    before = "undef"
    for k in range(LANES):
        text(f"""
            %ch{k} = extractelement {_INTS} %channel.view, i32 {k}
            %chw{k} = zext i32 %ch{k} to i64
            %chs{k} = mul i64 %chw{k}, {VIEW}
            %lane{k} = add i64 %first, {k}
            %own{k} = mul i64 %lane{k}, %stride
            %begin{k} = add i64 %own{k}, %chs{k}
            %from{k} = getelementptr float, ptr %views, i64 %begin{k}
            %eight{k} = load <8 x float>, ptr %from{k}, align 4
            %ninth{k} = getelementptr float, ptr %from{k}, i64 8
            %high{k} = load float, ptr %ninth{k}, align 4
            %highs{k} = insertelement {_FLOATS} {before}, float %high{k}, i32 {k}
        """)
        before = f"%highs{k}"
    rows = text.joined([f"eight{k}" for k in range(LANES)], "float", 8)
    for c in range(8):
        text.column(f"view{c}", rows, "float", 8, c)
    text(f"%view8 = fadd {_FLOATS} {before}, {_same('float', '-0.0')}")
    text(_MIDDLE)


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
        text(f"""
            %{vector}.p = getelementptr i32, ptr %{pointer}, i64 %first
            %{vector} = load {type_}, ptr %{vector}.p, align 4
        """)
    if not multi_view:
        _load_view(text)
    text("br label %loop")
    text.lines.append("loop:")
    text(f"%at = phi {_INTS} [%start, %entry], [%next, %loop]")
    _load_nodes(text)
    text(f"""
        %kind = and {_INTS} %word3, {_same("i32", 3)}
        %channel = ashr {_INTS} %word3, {_same("i32", 2)}
        %is_one = icmp eq {_INTS} %kind, {_same("i32", ONE_PROBE)}
        %is_scalar = icmp eq {_INTS} %kind, {_same("i32", SCALAR)}
    """)
    if multi_view:
        _load_views(text)
    for k, offset in enumerate(("u0", "u1", "u2", "v0", "v1", "v2")):
        text.signed_byte(offset, f"word{k // 4}", k % 4)
    text.pixel_of("under_u", ["u0", "u1", "u2"])
    text.pixel_of("under_v", ["v0", "v1", "v2"])
    text(f"""
        %scalar = add {_INTS} %own, %channel
        %place = select {_BITS} %is_scalar, {_INTS} %scalar, {_INTS} %under_u
    """)
    text.read("a", "place")
    text.read("b", "under_v")
    text(f"""
        %height = fmul {_FLOATS} %a, %inv
        %other = fmul {_FLOATS} %b, %inv
        %less = select {_BITS} %is_one, {_FLOATS} %view8, {_FLOATS} %other
        %difference = fsub {_FLOATS} %height, %less
        %value = select {_BITS} %is_scalar, {_FLOATS} %a, {_FLOATS} %difference
        %level = ashr {_INTS} %word1, {_same("i32", 16)}
        %threshold = sitofp {_INTS} %level to {_FLOATS}
        %right = fcmp oge {_FLOATS} %value, %threshold
        %step = zext {_BITS} %right to {_INTS}
        %child = add {_INTS} %word2, %step
        %inner = icmp sge {_INTS} %word2, zeroinitializer
        %next = select {_BITS} %inner, {_INTS} %child, {_INTS} %at
        %more = call i1 {_ANY}({_BITS} %inner)
        br i1 %more, label %loop, label %done
    """)
    return _FUNCTION.format(name=name, body="\n".join(text.lines))


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
