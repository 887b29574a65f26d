use grasp::{Dropped, Grasp};

use crate::pose::{self, PoseFields};
use crate::{FieldError, pb};

const POSE: PoseFields = PoseFields { position: "grasps.pose.position", orientation: "grasps.pose.orientation" };

impl From<&Grasp> for pb::Grasp {
    fn from(grasp: &Grasp) -> Self {
        let pose = Some((&grasp.pose).into());
        Self { pose, width: grasp.width, quality: grasp.quality, ..Self::default() }
    }
}

impl TryFrom<&pb::Grasp> for Grasp {
    type Error = FieldError;

    fn try_from(grasp: &pb::Grasp) -> Result<Self, FieldError> {
        let pose = grasp.pose.as_ref().ok_or_else(|| FieldError::new("grasps.pose", "absent", "must be given"))?;
        Ok(Self { pose: pose::decode(pose, &POSE)?, width: grasp.width, quality: grasp.quality })
    }
}

impl From<&Dropped> for pb::Dropped {
    fn from(dropped: &Dropped) -> Self {
        // No overflow: at most one per voxel, and `Volume::MAX_RESOLUTION`³ is 2²⁴.
        let count = |n: usize| n as u32;
        Self {
            below_threshold: count(dropped.below_threshold),
            mask: count(dropped.mask),
            width: count(dropped.width),
            region: count(dropped.region),
            approach: count(dropped.approach),
            height: count(dropped.height),
            suppressed: count(dropped.suppressed),
            collision: count(dropped.collision),
            over_limit: 0,
        }
    }
}
