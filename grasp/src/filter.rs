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
/// Results of at least `floor` (above 0) are exact, all other results are below `floor`. In most volumes few rows along
/// z reach it: those in which the largest values, filtered along x and y, do.
pub(crate) fn gaussian(values: &[f32], n: usize, sigma: f32, radius: usize, floor: f32) -> Vec<f32> {
    if sigma <= 0.0 || radius == 0 {
        return values.to_vec();
    }
    let kernel = gaussian_kernel(sigma, radius);
    let clamped = |i: usize| i.saturating_sub(radius).min(n - 1);
    let filtered = |target: &mut [f32], row: &dyn Fn(usize) -> usize, of: &[f32]| {
        weigh(target, &kernel, |k| &of[row(k) * n..][..n]);
    };

    // Bounds of the results of each row, with a margin for rounding.
    let largest: Vec<f32> = values.chunks_exact(n).map(|row| row.iter().copied().fold(f32::MIN, f32::max)).collect();
    let mut along_x = vec![0.0; n * n];
    for (x, target) in along_x.chunks_exact_mut(n).enumerate() {
        filtered(target, &|k| clamped(x + k), &largest);
    }
    let bound =
        |x: usize, y: usize| (0..kernel.len()).map(|k| kernel[k] * along_x[x * n + clamped(y + k)]).sum::<f32>();
    let rows = (0..n * n).filter(|&row| bound(row / n, row % n) + 1e-4 >= floor);

    let (mut smooth, mut filtered_x) = (vec![0.0; values.len()], vec![0.0; values.len()]);
    let mut is_filtered = vec![false; n * n];
    let (mut along_y, mut padded) = (vec![0.0; n], vec![0.0; n + 2 * radius]);
    for row in rows {
        let (x, y) = (row / n, row % n);
        for y in clamped(y)..=clamped(y + 2 * radius) {
            if !std::mem::replace(&mut is_filtered[x * n + y], true) {
                filtered(&mut filtered_x[(x * n + y) * n..][..n], &|k| clamped(x + k) * n + y, values);
            }
        }
        filtered(&mut along_y, &|k| x * n + clamped(y + k), &filtered_x);
        padded[..radius].fill(along_y[0]);
        padded[radius..radius + n].copy_from_slice(&along_y);
        padded[radius + n..].fill(along_y[n - 1]);
        weigh(&mut smooth[row * n..][..n], &kernel, |k| &padded[k..k + n]);
    }
    smooth
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
        let mut values: Vec<f32> = (0..N.pow(3)).map(|i| (i * 7919 % 1000) as f32 / 2500.0).collect();
        for (corner, size) in [([0, 0, 0], 3), ([8, 8, 8], 5), ([14, 3, 10], 4), ([4, 15, 2], 2)] {
            for (i, value) in values.iter_mut().enumerate() {
                let here = [i / (N * N), i / N % N, i % N];
                if here.iter().zip(corner).all(|(&c, low)| (low..low + size).contains(&c)) {
                    *value = 1.0;
                }
            }
        }
        let whole = gaussian(&values, N, 1.0, 4, 0.0);
        for floor in [0.3, 0.5, 0.9, 0.95] {
            let pruned = gaussian(&values, N, 1.0, 4, floor);
            assert!(whole.iter().any(|&value| value >= floor), "{floor} is reached");
            for (exact, value) in whole.iter().zip(pruned) {
                assert!(value == *exact || (value < floor && *exact < floor), "{exact} became {value}, floor {floor}");
            }
        }
    }
}
