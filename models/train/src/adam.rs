use tch::{Tensor, no_grad};

/// Adam (Kingma and Ba, "Adam: A Method for Stochastic Optimization", ICLR 2015, algorithm 1) with its default
/// constants and decoupled weight decay (Loshchilov and Hutter, "Decoupled Weight Decay Regularization", ICLR 2019).
/// libtorch's optimizer gives no access to its state, so that training could not be resumed.
pub struct Adam {
    weight_decay: f64,
    /// Steps taken: t.
    pub(crate) steps: u64,
    /// First and second moments of each parameter: m and v.
    pub(crate) moments: Vec<[Tensor; 2]>,
}

const BETA: [f64; 2] = [0.9, 0.999];
const EPSILON: f64 = 1e-8;

impl Adam {
    /// An optimizer for these parameters. Parameters of one dimension (biases and scales) do not decay.
    #[must_use]
    pub fn new(parameters: &[(String, Tensor)], weight_decay: f64) -> Self {
        let moments = parameters.iter().map(|(_, weight)| [0, 1].map(|_| weight.zeros_like().set_requires_grad(false)));
        Self { weight_decay, steps: 0, moments: moments.collect() }
    }

    /// Number of steps taken.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Updates every parameter and clears the gradients.
    pub fn step(&mut self, parameters: &[(String, Tensor)], learning_rate: f64) {
        self.steps += 1;
        // Corrections of the bias towards the initial 0 of both moments.
        let [first_correction, second_correction] = BETA.map(|beta| 1.0 - beta.powf(self.steps as f64));
        no_grad(|| {
            for ((_, weight), [first_moment, second_moment]) in parameters.iter().zip(&mut self.moments) {
                let mut weight = weight.shallow_clone();
                let gradient = weight.grad();
                if !gradient.defined() {
                    continue;
                }
                let _ = first_moment.lerp_(&gradient, 1.0 - BETA[0]);
                let _ = second_moment.lerp_(&gradient.square(), 1.0 - BETA[1]);
                let update = &*first_moment / ((&*second_moment / second_correction).sqrt() + EPSILON);
                if self.weight_decay > 0.0 && weight.dim() > 1 {
                    weight *= 1.0 - learning_rate * self.weight_decay;
                }
                weight -= update * (learning_rate / first_correction);
                weight.zero_grad();
            }
        });
    }
}
