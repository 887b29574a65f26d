mod support;
use grasp::VoxelOrigin;
use grasp_models::Architecture;
use grasp_train::*;
use tch::{Device, Kind, Tensor};
#[test]
fn tune() {
    tch::set_num_threads(1);
    for (n, cl) in [(16usize, true), (16, false), (40, true)] {
        let dataset = support::dataset(8, n);
        let ex = Executor::new(
            Architecture::Vgn.build(n, 0).unwrap(),
            Execution { device: Device::Cpu, bf16: true, channels_last: cl },
        )
        .unwrap();
        let mut adam = Adam::new(ex.parameters());
        let mut t = Targets::default();
        let mut v = vec![0f32; 8 * n * n * n];
        for (i, (s, o)) in dataset.scenes.iter().zip(v.chunks_exact_mut(n * n * n)).enumerate() {
            Transform::default().grid(&s.grid, n, o);
            for l in &s.labels {
                t.push(i, l, n, VoxelOrigin::Center);
            }
        }
        let e = n as i64;
        let x = Tensor::from_slice(&v).reshape([8, 1, e, e, e]);
        for step in 0..120 {
            let out = ex.forward(&x).unwrap();
            let bad: Vec<i64> = [&out.quality, &out.rotation, &out.width]
                .iter()
                .map(|t| t.isfinite().logical_not().to_kind(Kind::Int64).sum(None).int64_value(&[]))
                .collect();
            if bad.iter().any(|b| *b > 0) {
                println!("n {n} cl {cl} step {step} bad out {bad:?}");
                break;
            }
            let l = t.loss(&out, [1.0, 1.0]).unwrap();
            if step % 20 == 0 {
                println!("n {n} {step} {:?}", l.sums.loss());
            }
            l.mean.backward();
            let mut stop = false;
            for (name, p) in ex.parameters() {
                let g = p.grad();
                let b = g.isfinite().logical_not().to_kind(Kind::Int64).sum(None).int64_value(&[]);
                let m = g.abs().max().double_value(&[]);
                if b > 0 || m > 100.0 {
                    println!("n {n} cl {cl} step {step} grad {name} bad {b} of {} max {m}", g.numel());
                    stop = true;
                }
            }
            if stop {
                break;
            }
            adam.step(ex.parameters(), 1e-3);
        }
    }
}
