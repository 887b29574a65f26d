//! Filters over cubic arrays `[x][y][z]`, z fastest, with scipy's border rules.

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

/// Separable Gaussian filter with the nearest voxel repeated past the border. `sigma` and `radius` in voxels.
pub(crate) fn gaussian(values: &[f32], n: usize, sigma: f32, radius: usize) -> Vec<f32> {
    if sigma <= 0.0 || radius == 0 {
        return values.to_vec();
    }
    let kernel = gaussian_kernel(sigma, radius);
    let radius = kernel.len() / 2;
    let mut a = vec![0.0; values.len()];
    let mut b = vec![0.0; values.len()];
    along_blocks(values, &mut a, n, n * n, &kernel);
    for (source, target) in a.chunks_exact(n * n).zip(b.chunks_exact_mut(n * n)) {
        along_blocks(source, target, n, n, &kernel);
    }
    let mut padded = vec![0.0; n + 2 * radius];
    for (source, target) in b.chunks_exact(n).zip(a.chunks_exact_mut(n)) {
        padded[..radius].fill(source[0]);
        padded[radius..radius + n].copy_from_slice(source);
        padded[radius + n..].fill(source[n - 1]);
        weigh(target, &kernel, |k| &padded[k..k + n]);
    }
    a
}

/// Filters across `n` blocks of `block` values each: every output block is a weighted sum of whole blocks, which
/// vectorises whatever the axis.
fn along_blocks(source: &[f32], target: &mut [f32], n: usize, block: usize, kernel: &[f32]) {
    let radius = kernel.len() / 2;
    let mut blocks = Vec::with_capacity(kernel.len());
    for (i, target) in target.chunks_exact_mut(block).enumerate() {
        blocks.clear();
        blocks.extend((i..=i + 2 * radius).map(|j| {
            let j = j.saturating_sub(radius).min(n - 1);
            &source[j * block..(j + 1) * block]
        }));
        weigh(target, kernel, |k| blocks[k]);
    }
}

/// Values that are summed up together before they are written: few enough for the registers of any processor.
const LANES: usize = 8;

/// `target` becomes the sum of `source(k)`, each as long as it is, weighted by a kernel that is the same from both ends.
fn weigh<'a>(target: &mut [f32], kernel: &[f32], source: impl Fn(usize) -> &'a [f32]) {
    let radius = kernel.len() / 2;
    let (chunks, rest) = target.as_chunks_mut::<LANES>();
    let done = chunks.len() * LANES;
    for (chunk, target) in chunks.iter_mut().enumerate() {
        // As long as the target, the source has this chunk, too.
        let at = |k: usize| source(k)[chunk * LANES..].first_chunk::<LANES>().unwrap_or(&[0.0; LANES]);
        let mut sums = at(radius).map(|value| kernel[radius] * value);
        for (k, &weight) in kernel[..radius].iter().enumerate() {
            let (before, after) = (at(k), at(2 * radius - k));
            for lane in 0..LANES {
                sums[lane] += weight * (before[lane] + after[lane]);
            }
        }
        *target = sums;
    }
    for (index, target) in rest.iter_mut().enumerate() {
        *target = kernel.iter().enumerate().map(|(k, weight)| weight * source(k)[done + index]).sum();
    }
}

/// Binary dilation by the 6-neighbourhood, `iterations` times, growing only where `allowed`.
pub(crate) fn dilate(seed: Vec<bool>, allowed: &[bool], n: usize, iterations: usize) -> Vec<bool> {
    let mut current = seed;
    let mut next = current.clone();
    for _ in 0..iterations {
        // A row at a time: each of the six neighbours of a row of z is a shifted row.
        for row in 0..n * n {
            let (x, y) = (row / n, row % n);
            let range = row * n..(row + 1) * n;
            let target = &mut next[range.clone()];
            let mut grow = |from: usize| {
                for (t, s) in target.iter_mut().zip(&current[from * n..(from + 1) * n]) {
                    *t |= s;
                }
            };
            if x > 0 {
                grow(row - n);
            }
            if x + 1 < n {
                grow(row + n);
            }
            if y > 0 {
                grow(row - 1);
            }
            if y + 1 < n {
                grow(row + 1);
            }
            let here = &current[range.clone()];
            for (t, s) in target[1..].iter_mut().zip(here) {
                *t |= s;
            }
            for (t, s) in target.iter_mut().zip(&here[1..]) {
                *t |= s;
            }
            for ((t, s), allowed) in target.iter_mut().zip(here).zip(&allowed[range]) {
                *t = *s | (*t & allowed);
            }
        }
        current.copy_from_slice(&next);
    }
    current
}

/// Whether a voxel is the largest of its `size`³ window, `-size/2 … size - size/2 - 1` as in
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
