"""What hypothesis draws for rigid motion."""

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from numpy.typing import NDArray

Array = NDArray[np.float64]

few = settings(max_examples=20)
millimetres = st.floats(-1000.0, 1000.0)
# everyday angles, and those where a formula loses its digits
angles = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(-12.0, -3.0).map(lambda exponent: np.pi - 10.0**exponent),
    st.floats(-14.0, -2.0).map(lambda exponent: 10.0**exponent),
    st.sampled_from([0.0, 1e-4, 1e-3, np.pi - 1e-6, np.pi - 1e-12]),
)


@st.composite
def directions(draw: st.DrawFn) -> Array:
    """Unit vectors (3,), the axes among them."""
    axis = draw(st.sampled_from([None, 0, 1, 2]))
    if axis is not None:
        return np.eye(3)[axis] * draw(st.sampled_from([-1.0, 1.0]))
    v = np.array(draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3)))
    length = np.linalg.norm(v)
    return v / length if length > 0.1 else np.array([0.6, 0.0, 0.8])


@st.composite
def rotation_vectors(draw: st.DrawFn) -> Array:
    """Rotation vectors (3,) of length 0 to pi, rad."""
    return draw(angles) * draw(directions())


@st.composite
def twists(draw: st.DrawFn) -> Array:
    """Twists (6,) with a principal rotation, rad and mm."""
    return np.concatenate([draw(rotation_vectors()), draw(st.tuples(*[millimetres] * 3))])
