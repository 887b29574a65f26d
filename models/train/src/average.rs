use tch::{Tensor, no_grad};

/// An exponential moving average of the weights, which does better than where the last steps happened to lead.
pub(crate) struct Average {
    decay: f64,
    pub weights: Vec<Tensor>,
}

impl Average {
    pub fn new(decay: f64, parameters: &[(String, Tensor)]) -> Self {
        let weights = parameters.iter().map(|(_, weight)| no_grad(|| weight.copy()).set_requires_grad(false)).collect();
        Self { decay, weights }
    }

    /// Takes in the weights after a step, `steps` since the start. The average of a short past is a short one, lest it
    /// remember the random weights (Adam's TensorFlow implementation has the same ramp).
    pub fn update(&mut self, parameters: &[(String, Tensor)], steps: u64) {
        let decay = self.decay.min((1 + steps) as f64 / (10 + steps) as f64);
        no_grad(|| {
            for (average, (_, weight)) in self.weights.iter_mut().zip(parameters) {
                let _ = average.lerp_(weight, 1.0 - decay);
            }
        });
    }

    /// Puts the average in the weights' place, and the weights in the average's.
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
