use nalgebra::{Isometry3, Point3, Vector3};

use crate::{DEPTH_MAX, DepthImage};

/// Voxels projected per step.
const LANES: usize = 8;

/// Measures the distance of voxels from the surface in a depth image.
///
/// Follows Open3D's `UniformTSDFVolume`, which produced the data of VGN and GIGA: a voxel is sampled at its centre, its
/// pixel is `floor(u + 0.5)`, and the distance is measured along the ray of that pixel.
pub(crate) struct Measurement<'a> {
    depth: &'a [f32],
    width: usize,
    focal: [f32; 2],
    principal: [f32; 2],
    /// Pixel coordinates from which a voxel is outside the image.
    end: [f32; 2],
    /// `T_camera_field`.
    camera_from_field: Isometry3<f64>,
    voxel_size: f64,
    /// Step to the next voxel along z, in the camera's frame.
    step: Vector3<f32>,
    truncation: f32,
}

/// What an image shows at a voxel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Sample {
    /// The voxel lies behind a surface, farther than the truncation distance.
    Hidden,
    /// Signed distance from the surface as a fraction of the truncation distance, in (-1, 1]; positive in front of it.
    Distance(f32),
}

impl<'a> Measurement<'a> {
    /// The measurement of voxels with this edge, metres, in a field from which `camera_from_field` maps points into the
    /// camera frame. `truncation` is in metres.
    pub fn new(image: &'a DepthImage, camera_from_field: &Isometry3<f64>, voxel_size: f64, truncation: f32) -> Self {
        let camera = image.intrinsics();
        Self {
            depth: image.depth(),
            width: camera.width,
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            end: [camera.width as f32 - 1e-4, camera.height as f32 - 1e-4],
            camera_from_field: *camera_from_field,
            voxel_size,
            step: (camera_from_field.rotation * Vector3::new(0.0, 0.0, voxel_size)).cast(),
            truncation,
        }
    }

    /// Calls `visit` with what the image shows at `count` voxels along z, from voxel `first`, and their number from there.
    /// Voxels without a valid depth are left out.
    #[inline]
    pub fn column(&self, first: [usize; 3], count: usize, mut visit: impl FnMut(usize, Sample)) {
        let ([fx, fy], [u_end, v_end]) = (self.focal, self.end);
        let (inv_fx, inv_fy) = (1.0 / fx, 1.0 / fy);
        // Adding half a pixel turns truncation into rounding.
        let [cx, cy] = self.principal.map(|c| c + 0.5);
        let inv_truncation = 1.0 / self.truncation;
        let centre = Point3::from(first.map(|voxel| (voxel as f64 + 0.5) * self.voxel_size));
        let start = (self.camera_from_field * centre).coords.cast::<f32>();
        for chunk in (0..count).step_by(LANES) {
            // One chunk per iteration: the compiler turns this loop into vector instructions.
            let (mut us, mut vs, mut zs) = ([0.0; LANES], [0.0; LANES], [0.0; LANES]);
            for lane in 0..LANES {
                let point = start + self.step * (chunk + lane) as f32;
                let inv_z = 1.0 / point.z;
                us[lane] = point.x * fx * inv_z + cx;
                vs[lane] = point.y * fy * inv_z + cy;
                zs[lane] = point.z;
            }
            for lane in 0..LANES.min(count - chunk) {
                let (u, v, z) = (us[lane], vs[lane], zs[lane]);
                if !(z > 0.0 && u >= 1e-4 && u < u_end && v >= 1e-4 && v < v_end) {
                    continue;
                }
                // No overflow: the bounds check above passed.
                let (u, v) = (u as u32, v as u32);
                let d = self.depth[v as usize * self.width + u as usize];
                // Written so that NaN fails.
                if !(d > 0.0 && d <= DEPTH_MAX) {
                    continue;
                }
                // A ray is never shorter than its depth, so most voxels need no square root.
                let behind = d - z;
                let distance = if behind <= -self.truncation || behind >= self.truncation {
                    behind
                } else {
                    let [ray_x, ray_y] =
                        [(u as f32 - self.principal[0]) * inv_fx, (v as f32 - self.principal[1]) * inv_fy];
                    behind * (ray_x * ray_x + ray_y * ray_y + 1.0).sqrt()
                };
                let is_hidden = distance <= -self.truncation;
                let distance = Sample::Distance((distance * inv_truncation).min(1.0));
                visit(chunk + lane, if is_hidden { Sample::Hidden } else { distance });
            }
        }
    }
}
