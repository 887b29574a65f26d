use tch::{Tensor, no_grad};

/// Exponential moving average of the weights: average ← decay · average + (1 − decay) · weight after each step.
pub(crate) struct WeightAverage {
    decay: f64,
    pub weights: Vec<Tensor>,
}

impl WeightAverage {
    pub fn new(decay: f64, parameters: &[(String, Tensor)]) -> Self {
        let weights = parameters.iter().map(|(_, weight)| no_grad(|| weight.copy()).set_requires_grad(false)).collect();
        Self { decay, weights }
    }

    /// Updates the average after step number `steps`. In the first steps the decay is at most (1 + steps) / (10 + steps),
    /// as in TensorFlow's `ExponentialMovingAverage`, so that the average does not keep the random initial weights.
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
