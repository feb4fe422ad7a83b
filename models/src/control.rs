//! Linear-quadratic control on the discrete map.
