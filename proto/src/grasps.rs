use grasp::{Candidate, DetectParams, Dropped, Grasp, RequestError};

use crate::pb;
use crate::pose::{self, PoseFields};

const POSE: PoseFields = PoseFields { position: "grasps.pose.position", orientation: "grasps.pose.orientation" };

const CANDIDATE: PoseFields = PoseFields { position: "pose.position", orientation: "pose.orientation" };

/// Maximum number of candidates in a request.
const MAX_CANDIDATES: usize = 1024;

/// Converts the candidates of a request from the convention of its options.
///
/// # Errors
/// [`RequestError`] names the invalid field.
pub fn candidates(candidates: &[pb::Candidate], params: &DetectParams) -> Result<Vec<Candidate>, RequestError> {
    if !(1..=MAX_CANDIDATES).contains(&candidates.len()) {
        let needed = format_args!("must have from 1 to {MAX_CANDIDATES}");
        return Err(RequestError::of_length("candidates", candidates.len(), needed));
    }
    let depth = params.finger_depth();
    let candidate = |candidate: &pb::Candidate| {
        let pose = candidate.pose.as_ref().ok_or_else(|| RequestError::invalid("pose", "absent", "must be given"))?;
        let pose = params.convention.grasp(&pose::decode(pose, &CANDIDATE)?, depth);
        match candidate.width {
            Some(width) if !(0.0..=1.0).contains(&width) => {
                Err(RequestError::invalid("width", width, "must be from 0 to 1 m"))
            }
            width => Ok(Candidate { pose, width }),
        }
    };
    let indexed = candidates.iter().enumerate();
    indexed.map(|(index, c)| candidate(c).map_err(|error| error.inside(format_args!("candidates[{index}]")))).collect()
}

impl From<&Grasp> for pb::Grasp {
    fn from(grasp: &Grasp) -> Self {
        let pose = Some((&grasp.pose).into());
        Self { pose, width: grasp.width, quality: grasp.quality, ..Self::default() }
    }
}

impl TryFrom<&pb::Grasp> for Grasp {
    type Error = RequestError;

    fn try_from(grasp: &pb::Grasp) -> Result<Self, RequestError> {
        let pose =
            grasp.pose.as_ref().ok_or_else(|| RequestError::invalid("grasps.pose", "absent", "must be given"))?;
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
            object: count(dropped.object),
            suppressed: count(dropped.suppressed),
            collision: count(dropped.collision),
            over_limit: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Isometry3, Vector3};

    use super::*;

    #[test]
    fn candidates_are_converted_from_the_convention_of_the_request() {
        let convention = pb::Convention { origin: pb::convention::Origin::Tcp.into(), ..Default::default() };
        let options = pb::Options { convention: Some(convention), ..Default::default() };
        let params = DetectParams::try_from(&options).unwrap();
        let grasp = Isometry3::new(Vector3::new(0.1, 0.2, 0.3), Vector3::new(3.0, 0.0, 0.0));
        let [pose, ..] = params.poses(&grasp);
        let candidate = pb::Candidate { pose: Some((&pose).into()), width: None };
        let converted = candidates(&[candidate], &params).unwrap();
        assert!((converted[0].pose.to_homogeneous() - grasp.to_homogeneous()).norm() < 1e-12);
    }

    #[test]
    fn invalid_candidates_are_named() {
        let params = DetectParams::try_from(&pb::Options::default()).unwrap();
        let valid = pb::Candidate { pose: Some((&Isometry3::identity()).into()), width: Some(0.04) };
        let refused = |list: &[pb::Candidate]| candidates(list, &params).unwrap_err().to_string();
        assert_eq!(refused(&[]), "candidates has 0 entries, must have from 1 to 1024");
        let absent = pb::Candidate { pose: None, ..valid };
        assert_eq!(refused(&[valid, absent]), "candidates[1].pose is absent, must be given");
        let wide = pb::Candidate { width: Some(40.0), ..valid };
        assert_eq!(refused(&[wide]), "candidates[0].width is 40, must be from 0 to 1 m");
        let mut turned = valid;
        if let Some(orientation) = turned.pose.as_mut().and_then(|pose| pose.orientation.as_mut()) {
            orientation.w = f64::NAN;
        }
        assert!(refused(&[turned]).starts_with("candidates[0].pose.orientation is"));
    }
}
