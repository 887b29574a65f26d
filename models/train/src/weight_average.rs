use tch::{Tensor, no_grad};

/// An exponential moving average of the weights. It usually generalizes better than the last weights.
pub(crate) struct Average {
    decay: f64,
    pub weights: Vec<Tensor>,
}

impl Average {
    pub fn new(decay: f64, parameters: &[(String, Tensor)]) -> Self {
        let weights = parameters.iter().map(|(_, weight)| no_grad(|| weight.copy()).set_requires_grad(false)).collect();
        Self { decay, weights }
    }

    /// Updates the average after step number `steps`. The decay is smaller in the first steps, so that the average does
    /// not keep the random initial weights (the ramp of TensorFlow's `ExponentialMovingAverage`).
    pub fn update(&mut self, parameters: &[(String, Tensor)], steps: u64) {
        let decay = self.decay.min((1 + steps) as f64 / (10 + steps) as f64);
        no_grad(|| {
            for (average, (_, weight)) in self.weights.iter_mut().zip(parameters) {
                let _ = average.lerp_(weight, 1.0 - decay);
            }
        });
    }

    /// Exchanges the average and the weights.
    pub fn swap(&mut self, parameters: &[(String, Tensor)]) {
        no_grad(|| {
            for (average, (_, weight)) in self.weights.iter_mut().zip(parameters) {
                let kept = weight.copy();
                weight.shallow_clone().copy_(average);
                average.copy_(&kept);
            }
        });
    }
}
