/// The voxels of a volume whose centres are inside an object of the true scene, seen or not.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Occupancy {
    /// One bit per voxel in the order of the volume, least significant first.
    bits: Vec<u8>,
    voxels: usize,
}

impl Occupancy {
    /// No occupied voxels of `voxels`.
    #[must_use]
    pub fn empty(voxels: usize) -> Self {
        Self { bits: vec![0; Self::size(voxels)], voxels }
    }

    /// The occupancy of `voxels` voxels from its bytes; `None` if their number is wrong.
    pub(crate) fn from_bytes(bytes: &[u8], voxels: usize) -> Option<Self> {
        (bytes.len() == Self::size(voxels)).then(|| Self { bits: bytes.to_owned(), voxels })
    }

    /// Bytes of the occupancy of `voxels` voxels.
    pub(crate) fn size(voxels: usize) -> usize {
        voxels.div_ceil(8)
    }

    pub(crate) fn as_bytes(&self) -> &[u8] {
        &self.bits
    }

    /// Marks a voxel as occupied.
    ///
    /// # Panics
    /// If the volume has no voxel with this flat index.
    pub fn insert(&mut self, voxel: usize) {
        assert!(voxel < self.voxels, "voxel {voxel} of {}", self.voxels);
        self.bits[voxel / 8] |= 1 << (voxel % 8);
    }

    /// Whether a voxel, given by its flat index, is occupied.
    #[must_use]
    pub fn contains(&self, voxel: usize) -> bool {
        self.bits.get(voxel / 8).is_some_and(|byte| byte >> (voxel % 8) & 1 != 0)
    }

    /// The flat indices of the occupied voxels, ascending.
    pub fn occupied(&self) -> impl Iterator<Item = usize> {
        let bits = self.bits.iter().enumerate().filter(|(_, byte)| **byte != 0);
        bits.flat_map(|(index, byte)| (0..8).filter(move |bit| byte >> bit & 1 != 0).map(move |bit| 8 * index + bit))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn occupied_voxels_are_those_that_were_inserted() {
        let mut occupancy = Occupancy::empty(27);
        [26, 0, 9].into_iter().for_each(|voxel| occupancy.insert(voxel));
        assert_eq!(occupancy.occupied().collect::<Vec<_>>(), [0, 9, 26]);
        assert!(occupancy.contains(9) && !occupancy.contains(8) && !occupancy.contains(27));
        assert_eq!(Occupancy::from_bytes(occupancy.as_bytes(), 27), Some(occupancy.clone()));
        assert_eq!(Occupancy::from_bytes(occupancy.as_bytes(), 64), None);
    }
}
