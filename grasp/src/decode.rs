use nalgebra::{Isometry3, Translation3, Vector3};

use crate::filter::{gaussian, is_window_maximum, reaches};
use crate::selection::{Decoded, Dropped, Selection};
use crate::{Clearance, Constraints, DecodeError, FINGER_DEPTH, Grasp, Hand, Maps, Volume, VoxelOrigin};

/// Parameters of the decoding of a network's maps into grasps.
///
/// The defaults are those of VGN's released code. [`DecodeParams::benchmark`] gives those of GIGA's evaluation, with
/// which the paper's results were measured. Lengths are in voxels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecodeParams {
    /// σ of the Gaussian that smooths the quality (VGN `process`: 1). 0 disables it.
    pub sigma: f32,
    /// Radius at which the Gaussian is cut off (scipy: 4 σ).
    pub radius: usize,
    /// Values above this are in front of a surface (`out_th`: VGN 0.5, GIGA's evaluation 0.1).
    pub outside_above: f32,
    /// Values above this and below `outside_above` are inside an object (VGN: 1e-3).
    pub inside_above: f32,
    /// Number of dilations of the free space in front of surfaces, never into an object (VGN: 2).
    pub dilations: usize,
    /// Smallest valid width (VGN: 1.33).
    pub min_width: f32,
    /// Largest valid width (VGN: 9.33).
    pub max_width: f32,
    /// Border of the volume without grasps (GIGA), if any.
    pub border: Option<Border>,
    /// ε: the smallest smoothed quality of a grasp (0.9 in all three papers).
    pub threshold: f32,
    /// GIGA's `force`: if no voxel reaches `threshold`, the single best grasp of at least this quality is returned.
    pub force: Option<f32>,
    /// Edge of the window of the non-maximum suppression (VGN: 4).
    pub nms_size: usize,
    /// Collision check of the hand against the observed surfaces, if any. None of the papers uses one.
    pub clearance: Option<Clearance>,
    /// Further constraints on grasps.
    pub constraints: Constraints,
    /// The hand, if it is not the one that the network was trained with. Grasps keep the position of the fingertips,
    /// and wider grasps than this hand's opening are dropped.
    pub hand: Option<Hand>,
    /// Position of a grasp in its voxel.
    pub origin: VoxelOrigin,
}

/// Width of the border of the volume in which grasps are dropped, voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Border {
    /// Width at each of the four vertical faces.
    pub sides: usize,
    /// Width at the bottom.
    pub bottom: usize,
}

impl Default for DecodeParams {
    fn default() -> Self {
        Self {
            sigma: 1.0,
            radius: 4,
            outside_above: 0.5,
            inside_above: 1e-3,
            dilations: 2,
            min_width: 1.33,
            max_width: 9.33,
            border: None,
            threshold: 0.9,
            force: None,
            nms_size: 4,
            clearance: None,
            constraints: Constraints::default(),
            hand: None,
            origin: VoxelOrigin::Corner,
        }
    }
}

impl DecodeParams {
    /// The parameters of GIGA's evaluation: `out_th` 0.1, a border, and `force` 0.5.
    #[must_use]
    pub fn benchmark() -> Self {
        Self { outside_above: 0.1, border: Some(Border { sides: 2, bottom: 7 }), force: Some(0.5), ..Self::default() }
    }

    /// The smallest quality if no voxel reaches the threshold, with `force`.
    pub(crate) fn floor(&self) -> Option<f32> {
        self.force.map(|force| force.min(self.threshold))
    }
}

/// Decodes a network's maps over `volume` into grasps, best first (VGN's `process` and `select`, with GIGA's
/// additions). The grasps are in the frame of the volume's pose.
///
/// # Errors
/// [`DecodeError`] if a map has the wrong size, or an invalid value where it is used.
pub fn decode(volume: &Volume, maps: &Maps, params: &DecodeParams) -> Result<Decoded, DecodeError> {
    let n = volume.resolution();
    maps.check_quality(n)?;

    let selection = Selection::new(volume, params);
    let above = |threshold| {
        let smooth = gaussian(maps.quality, n, params.sigma, params.radius, threshold);
        candidates(volume, maps, &smooth, &selection, threshold, params)
    };
    let decoded = above(params.threshold)?;
    match params.floor() {
        Some(floor) if decoded.grasps.is_empty() => Ok(above(floor)?.best_alone()),
        _ => Ok(decoded),
    }
}

/// The smoothed quality at the voxels nearest to grasps at `poses`, which are in the frame of the volume's pose; 0 outside
/// the volume.
///
/// # Errors
/// [`DecodeError`] if the map has the wrong size.
pub fn quality_at(
    volume: &Volume,
    maps: &Maps,
    poses: &[Isometry3<f64>],
    params: &DecodeParams,
) -> Result<Vec<f32>, DecodeError> {
    let n = volume.resolution();
    maps.check_quality(n)?;
    let smooth = gaussian(maps.quality, n, params.sigma, params.radius, f32::MIN_POSITIVE);
    let quality = |pose: &Isometry3<f64>| {
        // The inverse of `grasp_at`.
        let pose = params.hand.map_or(*pose, |hand| pose * Translation3::new(0.0, 0.0, hand.depth - FINGER_DEPTH));
        let position = volume.pose().inverse_transform_point(&pose.translation.vector.into());
        let position = position.coords / volume.voxel_size();
        let is_inside = position.iter().all(|c| (0.0..=n as f64).contains(c));
        let nearest = |c: f64| (c - params.origin.offset()).round().clamp(0.0, (n - 1) as f64) as usize;
        let [x, y, z]: [usize; 3] = position.map(nearest).into();
        if is_inside { smooth[(x * n + y) * n + z] } else { 0.0 }
    };
    Ok(poses.iter().map(quality).collect())
}

/// The grasps of at least `threshold`, best first, and the reasons why the other voxels hold none.
fn candidates(
    volume: &Volume,
    maps: &Maps,
    smooth: &[f32],
    selection: &Selection,
    threshold: f32,
    params: &DecodeParams,
) -> Result<Decoded, DecodeError> {
    let n = volume.resolution();
    // Only for a custom hand: `max_width` already keeps a margin to the opening of the training hand.
    let opening = params.hand.map_or(f64::INFINITY, |hand| 2.0 * hand.half_opening());
    let mut dropped = Dropped::default();
    let mut quality = vec![0.0; smooth.len()];
    let mut passed = Vec::new();
    // Few rows along z contain a voxel above the threshold.
    let rows = smooth.chunks_exact(n).enumerate().filter(|(_, row)| reaches(row, threshold));
    let mut reached = 0;
    for (index, &q) in rows.flat_map(|(row, values)| (row * n..).zip(values)) {
        if q < threshold || q <= 0.0 {
            continue;
        }
        reached += 1;
        let width = maps.width[index];
        let count = if !is_near_free_space(volume, index, params, params.dilations) {
            &mut dropped.mask
        } else if !(width >= params.min_width && width <= params.max_width)
            || f64::from(width) * volume.voxel_size() > opening
        {
            &mut dropped.width
        } else if params.border.is_some_and(|border| border.contains(index, n)) {
            &mut dropped.border
        } else {
            let grasp = grasp_at(volume, maps, index, q, params)?;
            if selection.keeps(&grasp.pose, &mut dropped) {
                quality[index] = q;
                passed.push((index, grasp));
            }
            continue;
        };
        *count += 1;
    }
    dropped.below_threshold = smooth.len() - reached;
    let all = passed.len();
    passed.retain(|&(index, _)| is_window_maximum(&quality, n, index, params.nms_size));
    dropped.suppressed = all - passed.len();
    passed.sort_by(|(a, _), (b, _)| quality[*b].total_cmp(&quality[*a]).then(a.cmp(b)));
    Ok(Decoded { grasps: passed.into_iter().map(|(_, grasp)| grasp).collect(), dropped })
}

/// Whether a voxel is in front of a surface, or at most `steps` steps from one that is, without a step into an object.
fn is_near_free_space(volume: &Volume, index: usize, params: &DecodeParams, steps: usize) -> bool {
    let (value, n) = (volume.values()[index], volume.resolution());
    let is_outside = value > params.outside_above;
    let is_inside = value > params.inside_above && value < params.outside_above;
    let is_next_to_one = || {
        [1, n, n * n].into_iter().any(|stride| {
            let at = index / stride % n;
            let is_near = |to: usize| is_near_free_space(volume, to, params, steps - 1);
            (at > 0 && is_near(index - stride)) || (at + 1 < n && is_near(index + stride))
        })
    };
    is_outside || (steps > 0 && !is_inside && is_next_to_one())
}

impl Border {
    fn contains(self, index: usize, n: usize) -> bool {
        let side = |c: usize| c < self.sides || c + self.sides >= n;
        side(index / (n * n)) || side(index / n % n) || index % n < self.bottom
    }
}

fn grasp_at(
    volume: &Volume,
    maps: &Maps,
    index: usize,
    quality: f32,
    params: &DecodeParams,
) -> Result<Grasp, DecodeError> {
    let n = volume.resolution();
    let rotation = maps.rotation(index)?;
    let cell = Vector3::new(index / (n * n), index / n % n, index % n);
    let position = cell.map(|c| c as f64 + params.origin.offset()) * volume.voxel_size();
    let pose = volume.pose() * Isometry3::from_parts(Translation3::from(position), rotation);
    Ok(Grasp {
        // A custom hand keeps the position of the fingertips.
        pose: params.hand.map_or(pose, |hand| pose * Translation3::new(0.0, 0.0, FINGER_DEPTH - hand.depth)),
        width: f64::from(maps.width[index]) * volume.voxel_size(),
        quality,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cone, Region};

    const N: usize = 16;

    /// A slab with its surface at z = 8: free above, inside below, observed over ±4 voxels.
    fn slab() -> Volume {
        let values = (0..N.pow(3)).map(|i| ((i % N) as f32 - 4.0).clamp(0.0, 8.0) / 8.0 * f32::from(i % N <= 12));
        Volume::new(N, 0.0075, Isometry3::translation(1.0, 2.0, 3.0), values.collect()).unwrap()
    }

    struct Arrays {
        quality: Vec<f32>,
        rotation: Vec<f32>,
        width: Vec<f32>,
    }

    impl Arrays {
        fn new() -> Self {
            let voxels = N.pow(3);
            let mut rotation = vec![0.0; 4 * voxels];
            rotation[3 * voxels..].fill(1.0);
            Self { quality: vec![0.0; voxels], rotation, width: vec![5.0; voxels] }
        }

        fn decode(&self, params: &DecodeParams) -> Decoded {
            let maps = Maps { quality: &self.quality, rotation: &self.rotation, width: &self.width };
            let decoded = decode(&slab(), &maps, params).unwrap();
            let d = decoded.dropped;
            let constrained = d.region + d.approach + d.height;
            let all = d.below_threshold + d.mask + d.width + d.border + constrained + d.suppressed + d.collision;
            assert_eq!(all + decoded.grasps.len(), N.pow(3), "every voxel is counted once");
            decoded
        }
    }

    fn index(x: usize, y: usize, z: usize) -> usize {
        (x * N + y) * N + z
    }

    fn sharp() -> DecodeParams {
        DecodeParams { sigma: 0.0, ..DecodeParams::default() }
    }

    #[test]
    fn a_pose_has_the_quality_of_the_nearest_voxel_of_its_volume() {
        let mut arrays = Arrays::new();
        arrays.quality[index(N - 1, 3, 3)] = 0.75;
        let maps = Maps { quality: &arrays.quality, rotation: &arrays.rotation, width: &arrays.width };
        let volume = slab();
        let at = |x: f64| {
            let pose = volume.pose() * Isometry3::translation(x * 0.0075, 3.0 * 0.0075, 3.0 * 0.0075);
            quality_at(&volume, &maps, &[pose], &DecodeParams { origin: VoxelOrigin::Corner, ..sharp() }).unwrap()[0]
        };
        // The last voxel ends at 16; its corner, the origin of its grasp, is at 15.
        assert_eq!([14.4, 14.6, 15.0, 15.9, 16.1].map(at), [0.0, 0.75, 0.75, 0.75, 0.0]);
        arrays.quality[index(0, 3, 3)] = 0.5;
        let maps = Maps { quality: &arrays.quality, rotation: &arrays.rotation, width: &arrays.width };
        let before = volume.pose() * Isometry3::translation(-0.3 * 0.0075, 3.0 * 0.0075, 3.0 * 0.0075);
        let params = DecodeParams { origin: VoxelOrigin::Corner, ..sharp() };
        assert_eq!(quality_at(&volume, &maps, &[before], &params).unwrap(), [0.0], "outside");
    }

    #[test]
    fn a_peak_becomes_a_grasp_in_the_volumes_frame() {
        let mut arrays = Arrays::new();
        arrays.quality[index(3, 5, 9)] = 0.95;
        let corner = arrays.decode(&sharp()).grasps;
        assert_eq!(corner.len(), 1);
        let expected = nalgebra::Vector3::new(1.0 + 3.0 * 0.0075, 2.0 + 5.0 * 0.0075, 3.0 + 9.0 * 0.0075);
        assert!((corner[0].pose.translation.vector - expected).norm() < 1e-9);
        assert!((corner[0].width - 5.0 * 0.0075).abs() < 1e-9);
        let center = arrays.decode(&DecodeParams { origin: VoxelOrigin::Center, ..sharp() }).grasps;
        let half = nalgebra::Vector3::repeat(0.5 * 0.0075);
        assert!((center[0].pose.translation.vector - expected - half).norm() < 1e-9);
    }

    #[test]
    fn each_voxel_is_counted_under_the_first_reason() {
        let mut arrays = Arrays::new();
        arrays.quality[index(8, 8, 9)] = 0.99; // kept
        arrays.quality[index(8, 8, 10)] = 0.95; // suppressed by the first
        arrays.quality[index(8, 3, 9)] = 0.89; // below the threshold
        arrays.quality[index(3, 3, 6)] = 0.99; // inside the slab
        arrays.quality[index(3, 12, 9)] = 0.99; // width
        arrays.width[index(3, 12, 9)] = 1.0;
        arrays.quality[index(1, 8, 9)] = 0.99; // border
        let decoded = arrays.decode(&DecodeParams { border: Some(Border { sides: 2, bottom: 7 }), ..sharp() });
        assert_eq!(decoded.grasps.len(), 1);
        let expected = Dropped {
            below_threshold: N.pow(3) - 5,
            mask: 1,
            width: 1,
            border: 1,
            suppressed: 1,
            ..Dropped::default()
        };
        assert_eq!(decoded.dropped, expected);
    }

    #[test]
    fn free_space_is_near_within_two_steps_that_do_not_enter_an_object() {
        // Hidden voxels (0), one free voxel in the corner, and an object's voxel beside it.
        let at = |x: usize, y: usize, z: usize| (x * N + y) * N + z;
        let mut values = vec![0.0; N.pow(3)];
        values[at(0, 0, 0)] = 1.0;
        values[at(1, 0, 0)] = 0.3;
        let volume = Volume::new(N, 0.0075, Isometry3::identity(), values).unwrap();
        for index in 0..N.pow(3) {
            let [x, y, z] = [index / (N * N), index / N % N, index % N];
            // (2, 0, 0) is two steps away, but only through the object.
            let expected = x + y + z <= 2 && ![1, 2].map(|x| at(x, 0, 0)).contains(&index);
            assert_eq!(is_near_free_space(&volume, index, &DecodeParams::default(), 2), expected, "{x} {y} {z}");
        }
    }

    #[test]
    fn a_grasp_dropped_by_a_constraint_does_not_suppress_its_neighbour() {
        let mut arrays = Arrays::new();
        arrays.quality[index(8, 8, 9)] = 0.99;
        arrays.quality[index(9, 8, 9)] = 0.95;
        assert_eq!(arrays.decode(&sharp()).dropped.suppressed, 1);
        // The fingers point up: the tips are 0.05 m above the voxel. The volume's corner is at (1, 2, 3).
        let region = Region {
            frame: Isometry3::translation(1.0, 2.0, 3.0),
            lower: [8.5 * 0.0075, 0.0, 9.0 * 0.0075 + 0.05],
            upper: [1.0; 3],
        };
        let constraints = Constraints { region: Some(region), ..Constraints::default() };
        let decoded = arrays.decode(&DecodeParams { constraints, ..sharp() });
        assert_eq!(decoded.grasps.iter().map(|grasp| grasp.quality).collect::<Vec<_>>(), [0.95]);
        assert_eq!((decoded.dropped.region, decoded.dropped.suppressed), (1, 0));
        let approach = Some(Cone { axis: Vector3::x_axis(), angle: 0.5 });
        let constraints = Constraints { approach, min_height: Some(9.0), ..Constraints::default() };
        assert_eq!(arrays.decode(&DecodeParams { constraints, ..sharp() }).dropped.approach, 2);
        let constraints = Constraints { min_height: Some(9.0), ..Constraints::default() };
        assert_eq!(arrays.decode(&DecodeParams { constraints, ..sharp() }).dropped.height, 2);
    }

    #[test]
    fn a_custom_hand_keeps_the_fingertip_position() {
        let mut arrays = Arrays::new();
        arrays.quality[index(8, 8, 9)] = 0.99;
        let [own] = arrays.decode(&sharp()).grasps[..] else { panic!() };
        let hand = Hand::new(0.04, 0.12, 0.01, 0.02, [[0.0; 3]; 2]).unwrap();
        let [other] = arrays.decode(&DecodeParams { hand: Some(hand), ..sharp() }).grasps[..] else { panic!() };
        let tips = |grasp: Grasp, depth: f64| (grasp.pose * Translation3::new(0.0, 0.0, depth)).translation.vector;
        assert!((tips(own, FINGER_DEPTH) - tips(other, 0.12)).norm() < 1e-12);
        // 5 voxels are 0.0375 m.
        let narrow = Hand::new(0.037, 0.12, 0.01, 0.02, [[0.0; 3]; 2]).unwrap();
        assert_eq!(arrays.decode(&DecodeParams { hand: Some(narrow), ..sharp() }).dropped.width, 1);
    }

    #[test]
    fn grasps_in_collision_are_dropped() {
        let mut arrays = Arrays::new();
        arrays.quality[index(8, 8, 9)] = 0.99;
        arrays.quality[index(3, 3, 9)] = 0.95;
        // The identity rotation points up, from inside the slab; half a turn about x points down, onto the slab.
        let down = |arrays: &mut Arrays, index: usize| {
            arrays.rotation[index] = 1.0;
            arrays.rotation[3 * N.pow(3) + index] = 0.0;
        };
        down(&mut arrays, index(3, 3, 9));
        // Fingers too short to reach the slab from the grasp.
        let hand = Hand { depth: 0.005, ..Hand::PANDA };
        let clearance = Some(Clearance { hand, ..Clearance::default() });
        let grasps = |params: &DecodeParams| arrays.decode(params).grasps.iter().map(|g| g.quality).collect::<Vec<_>>();
        assert_eq!(grasps(&sharp()), [0.99, 0.95]);
        assert_eq!(grasps(&DecodeParams { clearance, ..sharp() }), [0.95]);
        assert_eq!(arrays.decode(&DecodeParams { clearance, ..sharp() }).dropped.collision, 1);
        // `force` chooses among the collision-free grasps.
        let forced = DecodeParams { clearance, threshold: 1.0, force: Some(0.5), ..sharp() };
        assert_eq!(grasps(&forced), [0.95]);

        // A dropped grasp does not suppress its neighbour.
        arrays.quality[index(9, 8, 9)] = 0.93;
        down(&mut arrays, index(9, 8, 9));
        let free = arrays.decode(&DecodeParams { clearance, ..sharp() });
        assert_eq!(free.grasps.iter().map(|grasp| grasp.quality).collect::<Vec<_>>(), [0.95, 0.93]);
        assert_eq!((free.dropped.collision, free.dropped.suppressed), (1, 0));
    }

    #[test]
    fn force_gives_the_single_best_only_when_nothing_passes() {
        let mut arrays = Arrays::new();
        arrays.quality[index(8, 8, 9)] = 0.7;
        arrays.quality[index(2, 2, 9)] = 0.8;
        assert_eq!(arrays.decode(&sharp()).grasps.len(), 0);
        let forced = DecodeParams { force: Some(0.5), ..sharp() };
        let grasps = arrays.decode(&forced).grasps;
        assert_eq!(grasps.len(), 1);
        assert_eq!(grasps[0].quality, 0.8);
        arrays.quality[index(8, 8, 9)] = 0.91;
        let grasps = arrays.decode(&forced).grasps;
        assert_eq!(grasps.len(), 1);
        assert_eq!(grasps[0].quality, 0.91);
    }

    #[test]
    fn invalid_maps_are_errors() {
        let mut arrays = Arrays::new();
        arrays.quality[7] = f32::NAN;
        let maps = Maps { quality: &arrays.quality, rotation: &arrays.rotation, width: &arrays.width };
        assert!(matches!(maps.check(N), Err(DecodeError::Value { map: "quality", index: 7, .. })));
        let fine = Arrays::new();
        let check = |rotation: &[f32], width: &[f32]| {
            Maps { quality: &fine.quality, rotation, width }.check(N).map_err(|error| error.to_string())
        };
        assert_eq!(check(&fine.rotation, &fine.width), Ok(()));
        assert!(check(&vec![0.0; 4 * N.pow(3)], &fine.width).unwrap_err().contains("has no finite length above 0"));
        assert!(
            check(&fine.rotation, &vec![f32::INFINITY; N.pow(3)]).unwrap_err().contains("width` is inf at index 0")
        );
        assert!(matches!(decode(&slab(), &maps, &sharp()), Err(DecodeError::Value { map: "quality", index: 7, .. })));
        let logits = vec![37.2; N.pow(3)];
        let error = decode(&slab(), &Maps { quality: &logits, ..maps }, &sharp()).unwrap_err().to_string();
        assert!(error.starts_with("map `quality` is 37.2 at index 0, must be a probability"), "{error}");
        let short = Maps { width: &arrays.width[1..], ..maps };
        assert!(matches!(decode(&slab(), &short, &sharp()), Err(DecodeError::Length { map: "width", .. })));
    }
}
