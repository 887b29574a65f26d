//! Filters over cubic arrays `[x][y][z]`, z fastest, with the border rules of scipy.

/// Gaussian weights for −radius…radius, normalised as `scipy.ndimage.gaussian_filter` does.
fn gaussian_kernel(sigma: f32, radius: usize) -> Vec<f32> {
    let sigma = f64::from(sigma);
    let weight = |i: usize| {
        let x = i as f64 - radius as f64;
        (-0.5 * x * x / (sigma * sigma)).exp()
    };
    let sum: f64 = (0..=2 * radius).map(weight).sum();
    (0..=2 * radius).map(|i| (weight(i) / sum) as f32).collect()
}

/// Separable Gaussian filter; the nearest voxel is repeated past the border. `sigma` and `radius` in voxels.
///
/// For `values` of at most `ceiling`: results of at least `floor` (above 0) are exact, all other results are below
/// `floor`. A result is bounded by its centre value, so most rows are skipped.
pub(crate) fn gaussian(values: &[f32], n: usize, sigma: f32, radius: usize, floor: f32, ceiling: f32) -> Vec<f32> {
    if sigma <= 0.0 || radius == 0 {
        return values.to_vec();
    }
    let kernel = gaussian_kernel(sigma, radius);
    // Smallest centre value that can give `average` when all its neighbours are at the ceiling, less a margin for
    // rounding.
    let center = |average: f32| ceiling - (ceiling - average) / kernel[radius] - 1e-4;
    let after_y = center(floor);
    let after_x = center(after_y);
    let clamped = |i: usize| i.saturating_sub(radius).min(n - 1);

    let mut along_x = vec![0.0; values.len()];
    for (x, target) in along_x.chunks_exact_mut(n * n).enumerate() {
        weigh(target, &kernel, |k| &values[clamped(x + k) * n * n..][..n * n]);
    }
    let mut along_y = vec![0.0; values.len()];
    for (row, target) in along_y.chunks_exact_mut(n).enumerate() {
        let (plane, y) = (&along_x[row / n * n * n..][..n * n], row % n);
        if reaches(&plane[y * n..][..n], after_x) {
            weigh(target, &kernel, |k| &plane[clamped(y + k) * n..][..n]);
        }
    }
    let mut along_z = along_x;
    let mut padded = vec![0.0; n + 2 * radius];
    for (source, target) in along_y.chunks_exact(n).zip(along_z.chunks_exact_mut(n)) {
        target.fill(0.0);
        if reaches(source, after_y) {
            padded[..radius].fill(source[0]);
            padded[radius..radius + n].copy_from_slice(source);
            padded[radius + n..].fill(source[n - 1]);
            weigh(target, &kernel, |k| &padded[k..k + n]);
        }
    }
    along_z
}

/// Whether any value is at least `floor`. The fold reads all values, which vectorises; an early exit does not.
pub(crate) fn reaches(values: &[f32], floor: f32) -> bool {
    values.iter().fold(false, |any, &value| any | (value >= floor))
}

/// Sets `target` to the sum of `source(k)` weighted by a symmetric kernel. All slices have the same length.
fn weigh<'a>(target: &mut [f32], kernel: &[f32], source: impl Fn(usize) -> &'a [f32]) {
    let radius = kernel.len() / 2;
    for (sum, center) in target.iter_mut().zip(source(radius)) {
        *sum = kernel[radius] * center;
    }
    for (k, &weight) in kernel[..radius].iter().enumerate() {
        add_weighed(target, weight, source(k), source(2 * radius - k));
    }
}

/// A separate function: with non-aliasing slices the compiler vectorises short rows too.
#[inline(never)]
fn add_weighed(sums: &mut [f32], weight: f32, before: &[f32], after: &[f32]) {
    for ((sum, before), after) in sums.iter_mut().zip(before).zip(after) {
        *sum += weight * (before + after);
    }
}

/// Binary dilation with the 6-neighbourhood, `iterations` times, only where `allowed`.
pub(crate) fn dilate(seed: &[bool], allowed: &[bool], n: usize, iterations: usize) -> Vec<bool> {
    // With one padding voxel per row and one padding row per plane, none of them `allowed`, each neighbour is the whole
    // array shifted by a constant, which vectorises.
    let (row, plane) = (n + 1, (n + 1) * (n + 1));
    let voxels = plane..(n + 1) * plane;
    let rows = |x: usize| (0..n).map(move |y| ((x + 1) * plane + y * row, (x * n + y) * n));
    let pad = |values: &[bool]| {
        let mut padded = vec![false; (n + 2) * plane];
        for (to, from) in (0..n).flat_map(rows) {
            padded[to..to + n].copy_from_slice(&values[from..from + n]);
        }
        padded
    };
    let (mut current, allowed) = (pad(seed), pad(allowed));
    let mut next = current.clone();
    for _ in 0..iterations {
        let around = [1, row, plane].map(|step| (&current[voxels.start - step..], &current[voxels.start + step..]));
        let target = next[voxels.clone()].iter_mut();
        let centers = current[voxels.clone()].iter().zip(&allowed[voxels.clone()]);
        let [(a, b), (c, d), (e, f)] = around;
        for ((((target, (center, allowed)), (a, b)), (c, d)), (e, f)) in
            target.zip(centers).zip(a.iter().zip(b)).zip(c.iter().zip(d)).zip(e.iter().zip(f))
        {
            *target = center | (allowed & (a | b | c | d | e | f));
        }
        std::mem::swap(&mut current, &mut next);
    }
    let mut dilated = vec![false; seed.len()];
    for (from, to) in (0..n).flat_map(rows) {
        dilated[to..to + n].copy_from_slice(&current[from..from + n]);
    }
    dilated
}

/// Whether a voxel is a maximum of its `size`³ window, `-size/2 … size - size/2 - 1` as in
/// `scipy.ndimage.maximum_filter`.
pub(crate) fn is_window_maximum(values: &[f32], n: usize, index: usize, size: usize) -> bool {
    let window = |c: usize| c.saturating_sub(size / 2)..(c + size - size / 2).min(n);
    let value = values[index];
    window(index / (n * n)).all(|x| {
        window(index / n % n).all(|y| {
            let row = (x * n + y) * n;
            let z = window(index % n);
            values[row + z.start..row + z.end].iter().all(|&other| other <= value)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const N: usize = 20;

    #[test]
    fn values_skipped_by_the_smoothing_are_below_the_floor() {
        // Plateaus of high values in several sizes, one at a corner, on low values.
        let ceiling = 1.001;
        let mut values: Vec<f32> = (0..N.pow(3)).map(|i| (i * 7919 % 1000) as f32 / 2500.0).collect();
        for (corner, size) in [([0, 0, 0], 3), ([8, 8, 8], 5), ([14, 3, 10], 4), ([4, 15, 2], 2)] {
            for (i, value) in values.iter_mut().enumerate() {
                let here = [i / (N * N), i / N % N, i % N];
                if here.iter().zip(corner).all(|(&c, low)| (low..low + size).contains(&c)) {
                    *value = ceiling;
                }
            }
        }
        let whole = gaussian(&values, N, 1.0, 4, 0.0, ceiling);
        for floor in [0.3, 0.5, 0.9, 0.95] {
            let pruned = gaussian(&values, N, 1.0, 4, floor, ceiling);
            assert!(whole.iter().any(|&value| value >= floor), "{floor} is reached");
            for (exact, value) in whole.iter().zip(pruned) {
                assert!(value == *exact || (value < floor && *exact < floor), "{exact} became {value}, floor {floor}");
            }
        }
    }

    #[test]
    fn dilation_stays_in_the_cube_and_in_allowed_voxels() {
        let at = |x: usize, y: usize, z: usize| (x * N + y) * N + z;
        let mut seed = vec![false; N.pow(3)];
        seed[at(0, 0, 0)] = true;
        seed[at(5, 5, N - 1)] = true;
        let mut allowed = vec![true; N.pow(3)];
        allowed[at(1, 0, 0)] = false;
        let dilated = dilate(&seed, &allowed, N, 2);
        let steps = |a: [usize; 3], b: [usize; 3]| a.iter().zip(b).map(|(a, b)| a.abs_diff(b)).sum::<usize>();
        for (i, grown) in dilated.into_iter().enumerate() {
            let here = [i / (N * N), i / N % N, i % N];
            // (2, 0, 0) is two steps away, but only through the voxel that is not allowed.
            let near = steps(here, [0, 0, 0]) <= 2 && !matches!(here, [1 | 2, 0, 0]);
            assert_eq!(grown, near || steps(here, [5, 5, N - 1]) <= 2, "{here:?}");
        }
    }
}
