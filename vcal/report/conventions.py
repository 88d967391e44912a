"""What pages of plans say of frames, signs and names."""

NAMES = (
    "Right-handed frames. Error = actual − nominal; a compensation subtracts it. Names of ISO "
    "230-1: E, then the component (X, Y, Z translations; A, B, C rotations about them), then the "
    "axis that moves; location errors such as EC0Y. Signs as parameters of the axis's own frame."
)
EXPANDED = "u is a standard uncertainty, U = k u with k = 2."
