//! A hash that never changes: digests of scenes and snapshots.

/// The 64-bit FNV-1a hash: no defence against anybody who wants a collision.
pub fn fnv1a(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3)
    })
}
