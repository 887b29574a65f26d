use std::path::PathBuf;

use grasp::{Details, Patch, WORKSPACE_SIZE};
use grasp_data::{DataError, Dataset, Setup};
use nalgebra::Isometry3;
use tch::Tensor;

use crate::Examples;

/// The tried grasps of networks, with the details of the volumes in which they were proposed. The images are patches.
/// Volumes are read as details in which nothing is free.
///
/// Class 0 is failure; 1 is success after a contact on the approach; 2 is success without a contact.
pub struct ProposalDataset {
    details: Vec<Details>,
    /// Name of the scene of each of them.
    scenes: Vec<String>,
    proposals: Vec<Proposal>,
}

struct Proposal {
    details: usize,
    /// In the frame of the details, metres.
    pose: Isometry3<f64>,
    class: usize,
}

impl ProposalDataset {
    /// Reads data sets of `grasp-sim proposals`; several are mixed.
    ///
    /// # Errors
    /// [`DataError`] names the folder that cannot be used.
    pub fn read(folders: &[PathBuf]) -> Result<Self, DataError> {
        let mut all = Self { details: Vec::new(), scenes: Vec::new(), proposals: Vec::new() };
        for path in folders {
            let dataset = Dataset::open(std::slice::from_ref(path))?;
            if Setup::read(path)?.provenance.is_some_and(|provenance| provenance.network.is_none()) {
                return Err(DataError::NoProposals(path.clone()));
            }
            let n = dataset.resolution();
            let voxel_size = WORKSPACE_SIZE / n as f64;
            for scene in 0..dataset.len() {
                let bytes = dataset.volume(scene, 0).to_vec();
                let details = Details::new(n, voxel_size, Isometry3::identity(), bytes).map_err(|error| {
                    let reason = format!("scene {}: {error}", dataset.id(scene));
                    DataError::Scene { path: path.clone(), reason, expected: "an observed volume" }
                })?;
                for trial in dataset.trials(scene) {
                    let class = match (trial.success, trial.share > 0.5) {
                        (true, _) => 2,
                        (false, true) => 1,
                        (false, false) => 0,
                    };
                    let pose = trial.grasp(voxel_size).pose;
                    all.proposals.push(Proposal { details: all.details.len(), pose, class });
                }
                all.details.push(details);
                all.scenes.push(dataset.id(scene).to_owned());
            }
        }
        Ok(all)
    }

    /// The tried grasps: the index of the details, and the pose in their frame.
    pub(crate) fn tried(&self) -> impl Iterator<Item = (usize, Isometry3<f64>)> {
        self.proposals.iter().map(|proposal| (proposal.details, proposal.pose))
    }

    /// The details with an index.
    pub(crate) fn details(&self, index: usize) -> &Details {
        &self.details[index]
    }

    /// The name of the scene of the details with an index.
    pub(crate) fn scene_of(&self, details: usize) -> &str {
        &self.scenes[details]
    }

    /// Slices of the patches of hands at poses in details, mirrored along x and the closing axis as `mirrored` says.
    pub(crate) fn patches(
        &self,
        poses: impl ExactSizeIterator<Item = (usize, Isometry3<f64>)>,
        mirrored: [bool; 2],
        slices: &[usize],
    ) -> Tensor {
        let [_, rows, columns] = Patch::SHAPE;
        let shape = [poses.len(), slices.len(), rows, columns];
        let size = slices.len() * rows * columns;
        let mut patches = vec![0.0; shape.iter().product()];
        for ((details, pose), patch) in poses.zip(patches.chunks_exact_mut(size)) {
            Patch::write_mirrored(&self.details[details], &pose, mirrored, slices, patch);
        }
        Tensor::from_slice(&patches).reshape(shape.map(|size| size as i64))
    }
}

impl Examples for ProposalDataset {
    fn len(&self) -> usize {
        self.proposals.len()
    }

    fn class(&self, index: usize) -> usize {
        self.proposals[index].class
    }

    fn classes(&self) -> usize {
        3
    }

    fn scene(&self, index: usize) -> String {
        self.scenes[self.proposals[index].details].clone()
    }

    fn images(&self, indices: &[i64], mirrored: [bool; 2]) -> Tensor {
        let poses = indices.iter().map(|&index| {
            let Proposal { details, pose, .. } = &self.proposals[index as usize];
            (*details, *pose)
        });
        self.patches(poses, mirrored, &Patch::ALL)
    }
}
