//! ONNX operators in libtorch.

use grasp_models::onnx::{AttributeProto, NodeProto};
use grasp_models::upsampled_taps;
use tch::{Device, Kind, TchError, Tensor};

use crate::execution_options::ExecutionOptions;
use crate::pointwise::PaddedFeatures;
use crate::supported::ExecuteError;
use crate::tensors::values_of;

/// One node with its input values.
pub(crate) struct NodeCall<'a> {
    pub node: &'a NodeProto,
    pub inputs: Vec<Option<&'a Tensor>>,
    pub execution: ExecutionOptions,
}

impl NodeCall<'_> {
    /// Computes the outputs of the node.
    pub fn run(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let one = |result: Result<Tensor, TchError>| Ok(vec![result.map_err(|source| self.torch_error(source))?]);
        match self.node.op_type() {
            "Add" => one(self.input(0)?.f_add(self.input(1)?)),
            "Clip" => one(self.input(0)?.f_clamp_tensor(self.optional_input(1), self.optional_input(2))),
            "Concat" => {
                let values: Vec<&Tensor> = self.inputs.iter().copied().flatten().collect();
                one(Tensor::f_cat(&values, self.int("axis", 0)))
            }
            "Conv" => self.convolution(false),
            "ConvTranspose" => self.convolution(true),
            "Div" => one(self.input(0)?.f_div(self.input(1)?)),
            "Erf" => one(self.input(0)?.f_erf()),
            "Expand" => one(self.input(0)?.f_broadcast_to(self.input_integers(1)?)),
            "Flatten" => {
                let x = self.input(0)?;
                let size = x.size();
                let axis = self.axis("axis", 1, size.len())?;
                one(x.f_reshape([size[..axis].iter().product(), -1]))
            }
            "InstanceNormalization" => {
                let [x, scale, bias] = [self.input(0)?, self.input(1)?, self.input(2)?];
                let epsilon = self.float("epsilon", 1e-5);
                one(x.f_instance_norm(Some(scale), Some(bias), None, None, true, 0.0, epsilon, false))
            }
            "LayerNormalization" => {
                let [x, scale, bias] = [self.input_f32(0)?, self.input_f32(1)?, self.input_f32(2)?];
                let size = x.size();
                let axis = self.axis("axis", -1, size.len())?;
                one(x.f_layer_norm(&size[axis..], Some(scale), Some(bias), self.float("epsilon", 1e-5), false))
            }
            "LeakyRelu" => {
                let (x, slope) = (self.input(0)?, self.float("alpha", 0.01));
                if slope as f32 == 0.01 {
                    one(x.f_leaky_relu())
                } else {
                    // The binding supports only the slope 0.01. PReLU supports any slope, but is six times slower.
                    one(x.f_prelu(&Tensor::from(slope).to_kind(x.kind()).to_device(x.device())))
                }
            }
            "MatMul" => one(self.input_reduced(0)?.f_matmul(&self.input_reduced(1)?)),
            "MaxPool" => self.max_pool(),
            "Mul" => one(self.input(0)?.f_mul(self.input(1)?)),
            "ReduceL2" => {
                // The axes are an attribute until opset 17 and an input since opset 18.
                let axes =
                    if self.optional_input(1).is_some() { self.input_integers(1)? } else { self.ints("axes", &[]) };
                if axes.is_empty() && self.int("noop_with_empty_axes", 0) != 0 {
                    return Err(self.unsupported("`noop_with_empty_axes`".to_owned()));
                }
                one(self.input_f32(0)?.f_norm_scalaropt_dim(2, axes, self.int("keepdims", 1) != 0))
            }
            "Relu" => one(self.input(0)?.f_relu()),
            "Reshape" => one(self.input(0)?.f_reshape(self.reshape_dims()?)),
            "Resize" => one(self.resize_nearest()?),
            "Shape" => one(Tensor::f_from_slice(&self.input(0)?.size())),
            "Sigmoid" => one(self.input_f32(0)?.f_sigmoid()),
            "Slice" => self.slice(),
            "Softmax" => one(self.input_f32(0)?.f_softmax(self.int("axis", -1), Kind::Float)),
            "Split" => {
                let sizes = self.input_integers(1)?;
                let split = self.input(0)?.f_split_with_sizes(sizes, self.int("axis", 0));
                split.map_err(|source| self.torch_error(source))
            }
            "Sub" => one(self.input(0)?.f_sub(self.input(1)?)),
            "Transpose" => {
                let x = self.input(0)?;
                let reversed: Vec<i64> = (0..x.dim() as i64).rev().collect();
                one(x.f_permute(self.ints("perm", &reversed)))
            }
            op => Err(ExecuteError::Operator { node: self.node.name().to_owned(), op: op.to_owned() }),
        }
    }

    fn convolution(&self, transposed: bool) -> Result<Vec<Tensor>, ExecuteError> {
        // oneDNN's bf16 weight gradient reads uninitialized memory when a volume is narrower than the kernel.
        let narrow =
            self.input(0)?.size().iter().zip(self.input(1)?.size()).skip(2).any(|(size, kernel)| *size < kernel);
        let [x, weight] = if narrow {
            [self.input_f32(0)?, self.input_f32(1)?]
        } else {
            [self.input_reduced(0)?, self.input_reduced(1)?]
        };
        let bias = self.optional_input(2).map(|bias| bias.to_kind(x.kind()));
        let axes = weight.dim().saturating_sub(2);
        let (ones, zeros) = (vec![1; axes], vec![0; axes]);
        let pads = self.ints("pads", &[0].repeat(2 * axes));
        let (begin, end) = pads.split_at(axes);
        if begin != end {
            return Err(self.unsupported(format!("a padding of {begin:?} before and {end:?} after")));
        }
        if !transposed && let Some(y) = self.patch_convolution(&x, &weight, bias.as_ref()) {
            return Ok(vec![y.map_err(|source| self.torch_error(source))?]);
        }
        let y = x.f_convolution(
            &weight,
            bias.as_ref(),
            self.ints("strides", &ones),
            begin,
            self.ints("dilations", &ones),
            transposed,
            &zeros,
            self.int("group", 1),
        );
        Ok(vec![y.map_err(|source| self.torch_error(source))?])
    }

    /// A convolution of one channel whose stride equals its kernel, computed as a matrix product. With oneDNN's
    /// convolution, this patch embedding took a fifth of the time of the transformer's convolutions. `None` for other
    /// convolutions.
    fn patch_convolution(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: Option<&Tensor>,
    ) -> Option<Result<Tensor, TchError>> {
        let (&[batch, 1, size, height, width], &[channels, 1, edge, ..]) =
            (x.size().as_slice(), weight.size().as_slice())
        else {
            return None;
        };
        let cube = |name| self.ints(name, &[]) == [edge; 3];
        let whole = height == size && width == size && size % edge == 0;
        let plain = |name, expected: i64| self.ints(name, &[]).iter().all(|&value| value == expected);
        if !(cube("strides") && cube("kernel_shape") && whole && plain("pads", 0) && plain("dilations", 1)) {
            return None;
        }
        let n = size / edge;
        let compute = || {
            let windows = x.f_reshape([batch, n, edge, n, edge, n, edge])?.f_permute([0, 1, 3, 5, 2, 4, 6])?;
            let y = windows.f_reshape([batch, n * n * n, -1])?.f_linear(&weight.f_reshape([channels, -1])?, bias)?;
            y.f_reshape([batch, n, n, n, channels])?.f_permute([0, 4, 1, 2, 3])
        };
        Some(compute())
    }

    /// A convolution of the input after upsampling by 2, computed on the input before upsampling
    /// ([`grasp_models::upsampled_convolutions`]).
    pub fn convolution_before_upsampling(&self) -> Result<Tensor, ExecuteError> {
        let (x, weight) = (self.input_reduced(0)?, self.input(1)?);
        let compute = || {
            let (channels, inputs, kernel, ..) = weight.size5()?;
            let (taps, small) = upsampled_taps(kernel as usize);
            let small = small as i64;
            // [2 · small, kernel]: for each parity, the taps of the large kernel that a tap of the small one sums.
            let sums = Tensor::f_zeros([2 * small, kernel], (Kind::Float, weight.device()))?;
            for (parity, taps) in (0..).zip(&taps) {
                for (tap, &position) in (0..).zip(taps) {
                    let _ = sums.f_get(parity * small + position as i64)?.f_get(tap)?.f_fill_(1.0)?;
                }
            }
            let weight = Tensor::f_einsum(
                "nabc,ia,jb,kc->nijk",
                &[weight.f_reshape([-1, kernel, kernel, kernel])?, sums.shallow_clone(), sums.shallow_clone(), sums],
                None::<i64>,
            )?;
            let weight = weight.f_reshape([channels, inputs, 2, small, 2, small, 2, small])?;
            let weight = weight.f_permute([2, 4, 6, 0, 1, 3, 5, 7])?;
            let weight = weight.f_reshape([8 * channels, inputs, small, small, small])?;
            let weight = self.execution.arrange(&weight).f_to_kind(x.kind())?;
            let bias = self.optional_input(2).map(|bias| bias.f_repeat([8])?.f_to_kind(x.kind())).transpose()?;
            let y = x.f_conv3d(&weight, bias.as_ref(), [1; 3], [small / 2; 3], [1; 3], 1)?;
            let (batch, _, edge, ..) = y.size5()?;
            let parts = y.f_reshape([batch, 2, 2, 2, channels, edge, edge, edge])?;
            parts.f_permute([0, 4, 5, 1, 6, 2, 7, 3])?.f_reshape([batch, channels, 2 * edge, 2 * edge, 2 * edge])
        };
        compute().map_err(|source| self.torch_error(source))
    }

    /// The maximum over windows of images.
    fn max_pool(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let x = self.input(0)?;
        let kernel = self.ints("kernel_shape", &[]);
        if x.dim() != 4 || kernel.len() != 2 {
            return Err(self.unsupported(format!("a window of {kernel:?} over {:?}", x.size())));
        }
        let pads = self.ints("pads", &[0; 4]);
        let (begin, end) = pads.split_at(2);
        if begin != end {
            return Err(self.unsupported(format!("a padding of {begin:?} before and {end:?} after")));
        }
        let (strides, dilations) = (self.ints("strides", &[1; 2]), self.ints("dilations", &[1; 2]));
        let y = x.f_max_pool2d(kernel, strides, begin, dilations, self.int("ceil_mode", 0) != 0);
        Ok(vec![y.map_err(|source| self.torch_error(source))?])
    }

    /// The input of a head, padded for kernels of at most `edge`³ voxels.
    pub fn padded_features(&self, edge: i64) -> Result<PaddedFeatures, ExecuteError> {
        PaddedFeatures::new(self.input(0)?, edge).map_err(|source| self.torch_error(source))
    }

    /// A convolution that preserves the size, only at `voxels`, which are flat indices into `[batch, N, N, N]`. Returns
    /// `[voxels.len(), channels, 1, 1, 1]`, computed in f32.
    pub fn convolution_at(&self, features: &PaddedFeatures, voxels: &[i64]) -> Result<Tensor, ExecuteError> {
        features.convolution(self.input(1)?, self.optional_input(2), voxels).map_err(|source| self.torch_error(source))
    }

    /// Nearest-neighbour upsampling: the modes of `Resize` that libtorch's `nearest` supports.
    fn resize_nearest(&self) -> Result<Result<Tensor, TchError>, ExecuteError> {
        for (name, expected) in
            [("mode", "nearest"), ("coordinate_transformation_mode", "asymmetric"), ("nearest_mode", "floor")]
        {
            let got = self.node.attribute(name).map(AttributeProto::s).unwrap_or_default();
            if got != expected.as_bytes() {
                let got = String::from_utf8_lossy(got);
                return Err(self.unsupported(format!("{name} `{got}` (only `{expected}`)")));
            }
        }
        let x = self.input(0)?;
        let size = match (self.optional_input(2).filter(|scales| scales.numel() > 0), self.optional_input(3)) {
            (Some(scales), _) => {
                let scales = values_of(scales);
                x.size().iter().zip(scales).map(|(&size, scale)| (size as f32 * scale).floor() as i64).collect()
            }
            (None, Some(_)) => self.input_integers(3)?,
            (None, None) => return Err(self.unsupported("neither scales nor sizes".to_owned())),
        };
        if x.dim() != 5 || size.len() != 5 || size[..2] != x.size()[..2] {
            return Err(self.unsupported(format!("resizing {:?} to {size:?}", x.size())));
        }
        Ok(x.f_upsample_nearest3d(&size[2..], None, None, None))
    }

    fn slice(&self) -> Result<Vec<Tensor>, ExecuteError> {
        let mut x = self.input(0)?.shallow_clone();
        let [starts, ends] = [self.input_integers(1)?, self.input_integers(2)?];
        let axes =
            if self.optional_input(3).is_some() { self.input_integers(3)? } else { (0..starts.len() as i64).collect() };
        let steps = if self.optional_input(4).is_some() { self.input_integers(4)? } else { vec![1; starts.len()] };
        for (((axis, start), end), step) in axes.into_iter().zip(starts).zip(ends).zip(steps) {
            x = x.f_slice(axis, start, end, step).map_err(|source| self.torch_error(source))?;
        }
        Ok(vec![x])
    }

    /// The target shape of a `Reshape`; 0 keeps the size of the input.
    fn reshape_dims(&self) -> Result<Vec<i64>, ExecuteError> {
        let size = self.input(0)?.size();
        let shape = self.input_integers(1)?.into_iter().enumerate();
        Ok(shape.map(|(axis, dim)| if dim == 0 { size.get(axis).copied().unwrap_or(0) } else { dim }).collect())
    }

    fn optional_input(&self, index: usize) -> Option<&Tensor> {
        self.inputs.get(index).copied().flatten()
    }

    fn input(&self, index: usize) -> Result<&Tensor, ExecuteError> {
        self.optional_input(index).ok_or_else(|| self.unsupported(format!("omitting input {index}")))
    }

    /// An input in f32, for operators that lose accuracy in bf16.
    fn input_f32(&self, index: usize) -> Result<Tensor, ExecuteError> {
        Ok(self.input(index)?.to_kind(Kind::Float))
    }

    /// An input in the precision of convolutions and matrix products.
    fn input_reduced(&self, index: usize) -> Result<Tensor, ExecuteError> {
        let kind = if self.execution.bf16 { Kind::BFloat16 } else { Kind::Float };
        Ok(self.input(index)?.to_kind(kind))
    }

    /// An input of integers.
    fn input_integers(&self, index: usize) -> Result<Vec<i64>, ExecuteError> {
        let tensor = self.input(index)?;
        Vec::<i64>::try_from(tensor.to_device(Device::Cpu)).map_err(|source| self.torch_error(source))
    }

    fn int(&self, name: &str, default: i64) -> i64 {
        self.node.attribute(name).and_then(|attribute| attribute.i).unwrap_or(default)
    }

    fn float(&self, name: &str, default: f32) -> f64 {
        self.node.attribute(name).and_then(|attribute| attribute.f).unwrap_or(default).into()
    }

    fn ints(&self, name: &str, default: &[i64]) -> Vec<i64> {
        self.node.attribute(name).map_or_else(|| default.to_vec(), |attribute| attribute.ints.clone())
    }

    /// An axis; negative values count from the end.
    fn axis(&self, name: &str, default: i64, dims: usize) -> Result<usize, ExecuteError> {
        let axis = self.int(name, default);
        let from_start = if axis < 0 { axis + dims as i64 } else { axis };
        usize::try_from(from_start)
            .ok()
            .filter(|&axis| axis < dims)
            .ok_or_else(|| self.unsupported(format!("axis {axis}")))
    }

    fn unsupported(&self, what: String) -> ExecuteError {
        ExecuteError::Unsupported { node: self.node.name().to_owned(), op: self.node.op_type().to_owned(), what }
    }

    fn torch_error(&self, source: TchError) -> ExecuteError {
        ExecuteError::torch(self.node, source)
    }
}
