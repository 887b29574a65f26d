use std::time::Instant;
use tch::{Device, Kind, Tensor};
fn cl(t: &Tensor) -> Tensor {
    t.permute([0, 2, 3, 4, 1]).contiguous().permute([0, 4, 1, 2, 3])
}
fn main() {
    tch::set_num_threads(1);
    let kind = Kind::BFloat16;
    for (ci, co, k, s, n) in [
        (1i64, 16i64, 5i64, 2i64, 40i64),
        (16, 32, 3, 2, 20),
        (32, 64, 3, 2, 10),
        (64, 64, 3, 1, 5),
        (64, 32, 3, 1, 10),
        (32, 16, 5, 1, 20),
        (16, 6, 5, 1, 40),
        (16, 8, 5, 1, 40),
        (16, 16, 5, 1, 40),
        (1, 8, 3, 1, 40),
        (8, 8, 3, 1, 40),
        (16, 8, 3, 1, 40),
        (16, 8, 1, 1, 40),
        (8, 6, 5, 1, 40),
        (32, 16, 3, 1, 20),
        (16, 16, 3, 1, 20),
    ] {
        let x =
            cl(&Tensor::randn([8, ci, n, n, n], (Kind::Float, Device::Cpu)).to_kind(kind)).set_requires_grad(ci > 1);
        let w = cl(&Tensor::randn([co, ci, k, k, k], (Kind::Float, Device::Cpu)).to_kind(kind)).set_requires_grad(true);
        let b = Tensor::zeros([co], (kind, Device::Cpu)).set_requires_grad(true);
        let mut fs = vec![];
        let mut ts = vec![];
        for _ in 0..4 {
            let t = Instant::now();
            let y = x.f_convolution(&w, Some(&b), [s; 3], [k / 2; 3], [1; 3], false, [0; 3], 1).unwrap();
            fs.push(t.elapsed().as_secs_f64());
            let g = y.ones_like();
            let v = [&x, &w, &b];
            let _ = Tensor::run_backward(&[y * g], &v[(if ci > 1 { 0 } else { 1 })..], false, false);
            ts.push(t.elapsed().as_secs_f64());
        }
        fs.sort_by(f64::total_cmp);
        ts.sort_by(f64::total_cmp);
        println!("conv {ci}->{co} k{k} s{s} n{n}: fwd {:.2} total {:.2} ms/vol", fs[1] * 125., ts[1] * 125.);
    }
    for (c, n) in [(64i64, 5i64), (32, 10), (16, 20)] {
        for last in [true, false] {
            let x0 = Tensor::randn([8, c, n, n, n], (Kind::Float, Device::Cpu)).to_kind(kind);
            let x = if last { cl(&x0) } else { x0 }.set_requires_grad(true);
            let up: Vec<(&str, Box<dyn Fn(&Tensor) -> Tensor>)> = vec![
                ("upsample", Box::new(move |x| x.upsample_nearest3d([2 * n; 3], None, None, None))),
                (
                    "expand",
                    Box::new(move |x| {
                        x.permute([0, 2, 3, 4, 1])
                            .reshape([8, n, 1, n, 1, n, 1, c])
                            .expand([8, n, 2, n, 2, n, 2, c], false)
                            .reshape([8, 2 * n, 2 * n, 2 * n, c])
                            .permute([0, 4, 1, 2, 3])
                    }),
                ),
            ];
            for (name, f) in up {
                let mut fs = vec![];
                let mut ts = vec![];
                for _ in 0..4 {
                    let t = Instant::now();
                    let y = f(&x);
                    fs.push(t.elapsed().as_secs_f64());
                    let g = y.ones_like();
                    let _ = Tensor::run_backward(&[y * g], &[&x], false, false);
                    ts.push(t.elapsed().as_secs_f64());
                }
                fs.sort_by(f64::total_cmp);
                ts.sort_by(f64::total_cmp);
                println!("{name} c{c} n{n} last {last}: fwd {:.2} total {:.2}", fs[1] * 125., ts[1] * 125.);
            }
        }
    }
    for (c, n) in [(8i64, 40i64)] {
        let x = cl(&Tensor::randn([8, c, n, n, n], (Kind::Float, Device::Cpu)).to_kind(kind)).set_requires_grad(true);
        let ops: Vec<(&str, Box<dyn Fn(&Tensor) -> Tensor>)> = vec![
            ("inorm bf16", Box::new(|x| x.instance_norm::<&Tensor>(None, None, None, None, true, 0.0, 1e-5, false))),
            (
                "inorm f32",
                Box::new(|x| {
                    x.to_kind(Kind::Float).instance_norm::<&Tensor>(None, None, None, None, true, 0.0, 1e-5, false)
                }),
            ),
            ("relu", Box::new(|x| x.relu())),
            ("cat", Box::new(|x| Tensor::cat(&[x, x], 1))),
            ("add f32", Box::new(|x| x + x.to_kind(Kind::Float))),
        ];
        for (name, f) in ops {
            let mut fs = vec![];
            let mut ts = vec![];
            for _ in 0..4 {
                let t = Instant::now();
                let y = f(&x);
                fs.push(t.elapsed().as_secs_f64());
                let g = y.ones_like();
                let _ = Tensor::run_backward(&[y * g], &[&x], false, false);
                ts.push(t.elapsed().as_secs_f64());
            }
            fs.sort_by(f64::total_cmp);
            ts.sort_by(f64::total_cmp);
            println!("{name}: fwd {:.2} total {:.2}", fs[1] * 125., ts[1] * 125.);
        }
    }
}
