//! Small training runs.

use std::sync::atomic::{AtomicBool, Ordering};

use grasp::VoxelOrigin;
use grasp_data::{Dataset, Setup, Trial, packed};
use grasp_models::onnx::ModelProto;
use grasp_models::{Architecture, Metadata, Options, Orientation};
use grasp_train::{
    Augmentation, Checkpoint, CheckpointError, EpochOutcome, EpochRecord, ExecutionOptions, Executor, LossWeights,
    NetworkOutputs, QualityTarget, Targets, Teacher, TrainError, Trainer, TrainingSettings,
};
use nalgebra::{Point3, UnitQuaternion, Vector3};
use tch::{Device, Kind, Tensor};

use crate::support;

const N: usize = 16;
const EXECUTION: ExecutionOptions = ExecutionOptions { device: Device::Cpu, bf16: false, channels_last: true };

fn settings() -> TrainingSettings {
    TrainingSettings {
        minutes: None,
        epochs: 3,
        batch: 3,
        accumulate: 1,
        learning_rate: 3e-3,
        warmup: 0,
        cosine: false,
        weight_decay: 0.0,
        average: None,
        seed: 5,
        validation: 0.0,
        augmentation: Augmentation::default(),
        balance: false,
        quality: QualityTarget::Label,
        rotation_weight: 1.0,
        occupancy: 0.0,
        voxel_origin: VoxelOrigin::Center,
        bf16: false,
    }
}

fn trainer(dataset: Dataset, settings: &TrainingSettings, execution: ExecutionOptions) -> Trainer {
    // More threads are no faster on volumes this small.
    tch::set_num_threads(1);
    let model = Architecture::Vgn.build(N, 0).unwrap();
    Trainer::new(model, dataset, settings.clone(), execution).unwrap()
}

fn epoch(trainer: &mut Trainer) -> EpochRecord {
    match trainer.epoch(&AtomicBool::new(false), |_, _| {}).unwrap() {
        EpochOutcome::Completed(record) => *record,
        EpochOutcome::Interrupted => panic!("the epoch was interrupted"),
    }
}

#[test]
fn eight_scenes_are_memorized() {
    use Orientation::{Axes, Quaternion};
    // Only the smallest network in bf16, which is slow without instructions for it. The 87 M parameters of the paper's
    // transformer get fewer epochs: one takes seconds.
    for (network, orientation, learning_rate, epochs, bf16, largest) in [
        (Architecture::Vgn, Quaternion, 1e-3, 60, false, 0.01),
        (Architecture::Vgn, Axes, 1e-3, 60, true, 0.02),
        (Architecture::TransformerSmall, Axes, 1e-3, 50, false, 0.01),
        (Architecture::Transformer, Quaternion, 2e-4, 12, false, 0.2),
    ] {
        let settings = TrainingSettings { batch: 8, learning_rate, warmup: 10, bf16, ..settings() };
        tch::set_num_threads(1);
        let model = network.build_with(N, orientation, 0).unwrap();
        let execution = ExecutionOptions { bf16, ..EXECUTION };
        let mut trainer = Trainer::new(model, support::dataset(8, N), settings, execution).unwrap();
        let first = epoch(&mut trainer);
        let last = (0..epochs).map(|_| epoch(&mut trainer)).last().unwrap();
        println!("{network:?}, {orientation:?}, bf16 {bf16}: loss {:.4} → {:.5}", first.loss, last.loss);
        assert!(first.loss > 0.5, "{network:?}: {first:?}");
        assert!(last.loss < largest, "{network:?}: {last:?}");
    }
}

/// The largest difference between two networks' weights.
fn difference(a: &ModelProto, b: &ModelProto) -> f32 {
    let weights = |model: &ModelProto| model.graph.as_ref().unwrap().initializer.clone();
    let pairs = weights(a).into_iter().zip(weights(b));
    let floats = pairs.filter_map(|(a, b)| Some((a.to_f32().ok()?, b.to_f32().ok()?)));
    floats.flat_map(|(a, b)| a.into_iter().zip(b).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>()).fold(0.0, f32::max)
}

#[test]
fn two_accumulated_batches_equal_one_of_twice_the_size() {
    let run = |batch: usize, accumulate: usize| {
        let settings = TrainingSettings { batch, accumulate, learning_rate: 1e-3, ..settings() };
        // All scenes have the same number of grasps, so that the mean of means is the mean.
        let mut trainer = trainer(support::dataset(8, N), &settings, EXECUTION);
        epoch(&mut trainer);
        assert_eq!(trainer.steps(), (8 / batch / accumulate) as u64);
        trainer.model()
    };
    let (halves, whole, other) = (run(2, 2), run(4, 1), run(8, 1));
    let close = difference(&halves, &whole);
    assert!(close < 2e-4, "{close}");
    assert!(difference(&halves, &other) > 1e-3);
}

#[test]
fn the_weight_average_changes_more_slowly_than_the_weights() {
    let run = |average: Option<f64>| {
        let mut trainer = trainer(support::dataset(8, N), &TrainingSettings { average, ..settings() }, EXECUTION);
        for _ in 0..2 {
            epoch(&mut trainer);
        }
        trainer.model()
    };
    let (plain, none, some) = (run(None), run(Some(0.0)), run(Some(0.9)));
    assert_eq!(difference(&plain, &none), 0.0, "an average with decay 0 equals the weights");
    let start = Architecture::Vgn.build(N, 0).unwrap();
    let (lag, way) = (difference(&plain, &some), difference(&plain, &start));
    assert!(lag > 0.0 && lag < way, "{lag} of {way}");
}

#[test]
fn weight_decay_reduces_the_weights() {
    let norm = |weight_decay: f64| {
        let mut trainer = trainer(support::dataset(8, N), &TrainingSettings { weight_decay, ..settings() }, EXECUTION);
        for _ in 0..3 {
            epoch(&mut trainer);
        }
        let weights = trainer.model().graph.unwrap().initializer;
        weights.iter().filter_map(|w| w.to_f32().ok()).flatten().map(|w| f64::from(w).powi(2)).sum::<f64>()
    };
    let (kept, decayed) = (norm(0.0), norm(1.0));
    assert!(decayed < 0.97 * kept, "{decayed} and {kept}");
}

#[test]
fn a_run_with_a_time_limit_ends_in_the_middle_of_an_epoch() {
    let settings = TrainingSettings { minutes: Some(1e-9), cosine: true, batch: 1, ..settings() };
    let mut run = trainer(support::dataset(8, N), &settings, EXECUTION);
    let record = epoch(&mut run);
    assert!(run.is_over());
    assert_eq!(record.steps, 1, "an epoch has at least one step");
    assert!(record.loss.is_finite());

    let mut resumed = trainer(support::dataset(8, N), &settings, EXECUTION);
    resumed.resume(&Checkpoint { seconds: 60.0, ..run.checkpoint() }).unwrap();
    assert!(resumed.is_over(), "the time before the interruption counts");

    let settings = TrainingSettings { minutes: Some(10.0), warmup: 4, ..settings };
    let rate = |step, minutes| settings.learning_rate_at(step, 1, minutes) / settings.learning_rate;
    assert_eq!(rate(1, 9.0), 0.5, "the warm-up follows the steps");
    assert!((rate(1000, 5.0) - 0.5).abs() < 1e-9, "half of the time");
    assert!(rate(1000, 10.0) < 1e-9);
}

#[test]
fn a_resumed_run_gives_the_same_result_as_an_uninterrupted_run() {
    let dataset = || support::dataset(8, N);
    let augmentation = Augmentation { rotate: true, mirror: true, shift: 1 };
    let settings = TrainingSettings {
        augmentation,
        validation: 0.5,
        cosine: true,
        warmup: 2,
        batch: 1,
        accumulate: 2,
        weight_decay: 0.1,
        average: Some(0.9),
        ..settings()
    };
    let mut whole = trainer(dataset(), &settings, EXECUTION);
    assert!(whole.scenes().1 > 0, "there are validation scenes");
    let records: Vec<_> = (0..3).map(|_| epoch(&mut whole)).collect();

    // A run that is interrupted after the first step of the second epoch. Its checkpoint is written to a file.
    let mut part = trainer(dataset(), &settings, EXECUTION);
    epoch(&mut part);
    let stop = AtomicBool::new(false);
    let ended = part.epoch(&stop, |_, _| stop.store(true, Ordering::Relaxed)).unwrap();
    assert_eq!(ended, EpochOutcome::Interrupted);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.state");
    part.checkpoint().write(&path).unwrap();
    let stored = Checkpoint::read(&path).unwrap().settings;
    assert!(stored.contains(r#""augmentation":{"turns":true,"#), "the name in earlier checkpoints: {stored}");
    drop(part);

    let mut resumed = trainer(dataset(), &settings, EXECUTION);
    resumed.resume(&Checkpoint::read(&path).unwrap()).unwrap();
    assert_eq!((resumed.epochs(), resumed.steps()), (1, whole.steps_per_epoch() + 1));
    for expected in &records[1..] {
        let got = epoch(&mut resumed);
        let comparable = |record: &EpochRecord| EpochRecord { seconds: 0.0, volumes_per_second: 0.0, ..record.clone() };
        assert_eq!(comparable(&got), comparable(expected));
    }
    assert_eq!(resumed.model(), whole.model(), "bit-identical");
}

#[test]
fn a_student_matches_its_teacher_where_there_are_no_trials() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("teacher.onnx");
    let settings = TrainingSettings { batch: 8, learning_rate: 1e-3, ..settings() };
    let mut teacher_run = trainer(support::dataset(8, N), &settings, EXECUTION);
    for _ in 0..60 {
        epoch(&mut teacher_run);
    }
    let teacher_model = teacher_run.model();
    let mut metadata = Metadata::from_model(&teacher_model, &path).unwrap();
    metadata.voxel_origin = VoxelOrigin::Center;
    let mut file = teacher_model.clone();
    metadata.write_to(&mut file);
    file.write(&path).unwrap();

    // The student's scenes are not in the teacher's data. Most voxels near their surfaces have no trial.
    let scenes = || Dataset::new((100..108).map(|seed| support::scene(seed, N)).collect()).unwrap();
    let teacher = || Teacher::load(&path, &Options::default(), 10.0).unwrap();
    let start = || {
        let model = Architecture::Vgn.build(N, 1).unwrap();
        Trainer::new(model, scenes(), settings.clone(), EXECUTION).unwrap()
    };
    let (mut without_teacher, mut student) = (start(), start().with_teacher(teacher()));
    for _ in 0..150 {
        epoch(&mut without_teacher);
        epoch(&mut student);
    }

    let qualities = |model: &ModelProto| {
        let values: Vec<f32> =
            (0..scenes().len()).flat_map(|scene| scenes().volume(scene, 0).to_vec()).map(grasp_data::value).collect();
        let volumes = Tensor::from_slice(&values).reshape([-1, 1, N as i64, N as i64, N as i64]);
        let executor = Executor::new(model.clone(), EXECUTION).unwrap();
        tch::no_grad(|| executor.forward(&volumes).unwrap().quality)
    };
    let teacher_qualities = qualities(&teacher_model);
    let distance =
        |model: &ModelProto| (qualities(model) - &teacher_qualities).abs().mean(Kind::Float).double_value(&[]);
    let (without, with) = (distance(&without_teacher.model()), distance(&student.model()));
    println!("mean difference of quality to the teacher's: {without:.3} without its outputs, {with:.3} with them");
    assert!(with < without / 2.0, "{with} and {without}");

    // Voxels are drawn again in every step. A resumed run draws the same voxels.
    let mut resumed = start().with_teacher(teacher());
    resumed.resume(&student.checkpoint()).unwrap();
    epoch(&mut resumed);
    epoch(&mut student);
    assert_eq!(resumed.model(), student.model(), "bit-identical");
    let is_refused = |mut trainer: Trainer| {
        let result = trainer.resume(&student.checkpoint());
        matches!(result, Err(TrainError::Checkpoint(CheckpointError::Settings { .. })))
    };
    assert!(is_refused(start()), "the teacher is missing");
    let mut other = Architecture::Vgn.build(N, 2).unwrap();
    metadata.write_to(&mut other);
    other.write(&path).unwrap();
    assert!(is_refused(start().with_teacher(teacher())), "another teacher with the same name and version");
}

#[test]
fn scenes_added_during_a_run_are_used() {
    let folder = tempfile::tempdir().unwrap();
    let provenance = support::provenance();
    let mut writer = packed::Writer::open(folder.path(), &Setup::benchmark(provenance)).unwrap();
    let mut write = |numbers: std::ops::Range<u64>| {
        for number in numbers {
            let scene = support::scene(number, N);
            let volume: Vec<f32> = scene.volumes[0].iter().map(|&byte| grasp_data::value(byte)).collect();
            // Two volumes per scene, from which the plan draws one.
            writer.append(number, &[volume.clone(), volume], &scene.trials, None).unwrap();
        }
    };
    write(0..4);
    let open = || Dataset::open(&[folder.path().to_owned()]).unwrap();
    let mut whole = trainer(open(), &settings(), EXECUTION);
    epoch(&mut whole);
    write(4..8);
    assert_eq!(whole.follow().unwrap(), 4);
    assert_eq!(whole.scenes().0 + whole.scenes().1, 8);
    let stop = AtomicBool::new(false);
    whole.epoch(&stop, |_, _| stop.store(true, Ordering::Relaxed)).unwrap();
    write(8..12);
    assert_eq!(whole.follow().unwrap(), 0, "scenes are not added within an epoch");

    // A resumed run uses the scenes of its checkpoint, although the folder has more.
    let mut resumed = trainer(open(), &settings(), EXECUTION);
    resumed.resume(&whole.checkpoint()).unwrap();
    for trainer in [&mut whole, &mut resumed] {
        epoch(trainer);
        assert_eq!(trainer.follow().unwrap(), 4);
        epoch(trainer);
    }
    assert_eq!(resumed.model(), whole.model(), "bit-identical");
}

#[test]
fn shapes_are_completed_by_a_head_that_the_model_does_not_contain() {
    let settings = TrainingSettings { batch: 8, learning_rate: 1e-3, validation: 0.2, occupancy: 1.0, ..settings() };
    let mut whole = trainer(support::dataset(16, N), &settings, EXECUTION);
    let first = epoch(&mut whole);
    let checkpoint = whole.checkpoint();
    let mut resumed = trainer(support::dataset(16, N), &settings, EXECUTION);
    resumed.resume(&checkpoint).unwrap();
    assert_eq!(epoch(&mut resumed).loss_occupancy, epoch(&mut whole).loss_occupancy);
    assert_eq!(resumed.model(), whole.model(), "bit-identical");

    let last = (0..40).map(|_| epoch(&mut whole)).last().unwrap();
    // A head that knows nothing but the share of occupied voxels has ln 2, because half of the voxels are occupied.
    let (before, after) = (first.loss_occupancy.unwrap(), last.loss_occupancy.unwrap());
    assert!(before > 0.5 && after < 0.2, "{before} before, {after} after");
    assert!(last.validation.unwrap().loss_occupancy.unwrap() < 0.4, "{:?}", last.validation);
    let names = |model: &ModelProto| -> Vec<String> {
        let graph = model.graph.as_ref().unwrap();
        let weights = graph.initializer.iter().map(|weight| weight.name().to_owned());
        weights.chain(graph.output.iter().map(|output| output.name().to_owned())).collect()
    };
    assert_eq!(names(&whole.model()), names(&Architecture::Vgn.build(N, 0).unwrap()));

    let mut without = trainer(support::dataset(16, N), &TrainingSettings { occupancy: 0.0, ..settings }, EXECUTION);
    assert!(without.resume(&checkpoint).is_err(), "another run");
    let record = epoch(&mut without);
    assert_eq!((record.loss_occupancy, record.validation.unwrap().loss_occupancy), (None, None));
}

#[test]
fn completion_of_shapes_needs_scenes_with_their_occupancy() {
    let scene = |seed, known: bool| {
        let scene = support::scene(seed, N);
        grasp_data::Scene { occupancy: scene.occupancy.filter(|_| known), ..scene }
    };
    let settings = TrainingSettings { occupancy: 1.0, ..settings() };
    let start = |known: u64| {
        let dataset = Dataset::new((0..8).map(|seed| scene(seed, seed < known)).collect()).unwrap();
        Trainer::new(Architecture::Vgn.build(N, 0).unwrap(), dataset, settings.clone(), EXECUTION)
    };
    let error = start(0).err().unwrap().to_string();
    assert!(error.contains("--occupancy needs scenes with their occupancy"), "{error}");
    assert!(epoch(&mut start(4).unwrap()).loss_occupancy.is_some(), "the others are used without");
}

#[test]
fn a_checkpoint_of_another_run_is_refused() {
    let scenes = || (0..4).map(|seed| support::scene(seed, N)).collect::<Vec<_>>();
    let dataset = || Dataset::new(scenes()).unwrap();
    let checkpoint = trainer(dataset(), &settings(), EXECUTION).checkpoint();
    let refused = |error| matches!(error, Err(TrainError::Checkpoint(CheckpointError::Settings { .. })));
    let mut other = trainer(dataset(), &TrainingSettings { seed: 6, ..settings() }, EXECUTION);
    assert!(refused(other.resume(&checkpoint)));
    let mut other = trainer(dataset(), &TrainingSettings { quality: QualityTarget::Share, ..settings() }, EXECUTION);
    assert!(refused(other.resume(&checkpoint)));
    let (mut relabelled, mut shared, mut renamed) = (scenes(), scenes(), scenes());
    relabelled[3].trials[0].width += 0.5;
    shared[3].trials[0].share = 0.5;
    "other".clone_into(&mut renamed[3].id);
    for scenes in [relabelled, shared, renamed] {
        let mut other = trainer(Dataset::new(scenes).unwrap(), &settings(), EXECUTION);
        assert!(refused(other.resume(&checkpoint)), "the same number of scenes, but other scenes");
    }
    let short = Checkpoint { sums: vec![0.0; 3], ..checkpoint.clone() };
    let cut = trainer(dataset(), &settings(), EXECUTION).resume(&short);
    assert!(matches!(cut, Err(TrainError::Checkpoint(CheckpointError::Sums(3)))));
    let mut longer = trainer(dataset(), &TrainingSettings { epochs: 9, ..settings() }, EXECUTION);
    assert!(longer.resume(&checkpoint).is_ok(), "a run with a constant learning rate can be extended");
    let model = Architecture::TransformerSmall.build(N, 0).unwrap();
    let mut other = Trainer::new(model, dataset(), settings(), EXECUTION).unwrap();
    assert!(matches!(other.resume(&checkpoint), Err(TrainError::Checkpoint(CheckpointError::Weights(_)))));
}

#[test]
fn a_run_without_scenes_is_refused() {
    let empty = Dataset::new(Vec::new()).unwrap();
    let model = Architecture::Vgn.build(N, 0).unwrap();
    let error = Trainer::new(model, empty, settings(), EXECUTION).err().unwrap();
    assert!(error.to_string().contains("no training scenes"), "{error}");
}

#[test]
fn divergence_is_an_error() {
    let mut trainer =
        trainer(support::dataset(8, N), &TrainingSettings { learning_rate: 1e30, ..settings() }, EXECUTION);
    let error = (0..5).find_map(|_| trainer.epoch(&AtomicBool::new(false), |_, _| {}).err()).unwrap();
    assert!(error.to_string().contains("smaller learning rate"), "{error}");
}

/// The same outputs at two voxels.
fn outputs(quality: f32, rotation: [f32; 4], width: f32) -> NetworkOutputs {
    let fill = |values: &[f32]| Tensor::from_slice(values).reshape([1, -1, 1, 1, 1]).repeat([2, 1, 1, 1, 1]);
    NetworkOutputs { quality: fill(&[quality]), rotation: fill(&rotation), width: fill(&[width]) }
}

#[test]
fn the_loss_follows_the_papers_equation() {
    let n = 2;
    let label = Trial {
        position: Point3::new(1.2, 0.7, 1.9),
        rotation: UnitQuaternion::from_euler_angles(0.3, -0.8, 1.1),
        width: 4.0,
        success: true,
        yaws: 0,
        share: 1.0,
        clearance: 0.0,
    };
    let mut targets = Targets::default();
    targets.push(1, &label, n, VoxelOrigin::Center, QualityTarget::Label);
    targets.push(0, &Trial { success: false, ..label }, n, VoxelOrigin::Center, QualityTarget::Label);
    assert_eq!(targets.len(), 2);

    // A rotation by 180° about the approach, and the sign of the quaternion, do not change the loss.
    let half_turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
    for rotation in [label.rotation, label.rotation * half_turn] {
        for sign in [1.0, -1.0] {
            let rotation: [f32; 4] = (rotation.coords * sign).map(|c| c as f32).into();
            let loss = targets.loss(&outputs(0.8, rotation, 6.0), &LossWeights::default()).unwrap();
            // −ln 0.8 for the success, −ln 0.2 for the failure; 0.01 · 2² for the width.
            let expected = (-(0.8_f64.ln()) - 0.2_f64.ln() + 0.01 * 4.0) / 2.0;
            assert!((loss.mean.double_value(&[]) - expected).abs() < 1e-5);
            assert!((loss.sums.loss() - expected).abs() < 1e-5);
            assert_eq!((loss.sums.accuracy(), loss.sums.precision(), loss.sums.recall()), (0.5, 0.5, 1.0));
        }
    }
    // Other valid yaws have the same loss.
    let with_yaw = |k: u8| {
        let mut targets = Targets::default();
        targets.push(0, &Trial { yaws: 1 << k, ..label }, n, VoxelOrigin::Center, QualityTarget::Label);
        targets
    };
    let yaw = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 2.0 * std::f64::consts::PI / 5.0);
    let rotation: [f32; 4] = (label.rotation * yaw).coords.map(|c| c as f32).into();
    let rotation_loss = |targets: &Targets| {
        let NetworkOutputs { quality, rotation, width } = outputs(0.8, rotation, 4.0);
        let first = |map: Tensor| map.narrow(0, 0, 1);
        let outputs = NetworkOutputs { quality: first(quality), rotation: first(rotation), width: first(width) };
        targets.loss(&outputs, &LossWeights::default()).unwrap().sums.rotation
    };
    assert!(rotation_loss(&with_yaw(2)).abs() < 1e-5);
    let off_by_a_step = 1.0 - (std::f64::consts::PI / 10.0).cos();
    assert!((rotation_loss(&with_yaw(1)) - off_by_a_step).abs() < 1e-5);
    let quarter = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let rotation: [f32; 4] = (label.rotation * quarter).coords.map(|c| c as f32).into();
    let loss = targets.loss(&outputs(0.8, rotation, 4.0), &LossWeights { classes: [1.0, 3.0], rotation: 2.0 }).unwrap();
    let worst = 1.0 - 0.5_f64.sqrt();
    assert!((loss.sums.rotation - 3.0 * 2.0 * worst).abs() < 1e-5, "90° about z has the largest loss");
    assert!((loss.sums.angle() - 90.0).abs() < 1e-3, "{}", loss.sums.angle());
    assert!((loss.sums.quality - (-3.0 * 0.8_f64.ln() - 0.2_f64.ln())).abs() < 1e-5, "classes are weighted");
}

#[test]
fn the_target_of_the_quality_is_the_label_or_the_share() {
    let label = Trial {
        position: Point3::new(0.5, 0.5, 0.5),
        rotation: UnitQuaternion::identity(),
        width: 4.0,
        success: true,
        yaws: 0,
        share: 0.5,
        clearance: 0.0,
    };
    let sums = |choice: QualityTarget, quality: f32| {
        let mut targets = Targets::default();
        for trial in [label, Trial { position: Point3::new(1.5, 0.5, 0.5), ..label }] {
            targets.push(0, &trial, 2, VoxelOrigin::Center, choice);
        }
        let weights = LossWeights { classes: [1.0, 3.0], rotation: 2.0 };
        targets.loss(&outputs(quality, [1.0, 0.0, 0.0, 0.0], 6.0), &weights).unwrap().sums
    };
    let least = |choice: QualityTarget| {
        let loss = |percent: &i32| sums(choice, *percent as f32 / 100.0).loss();
        (1..100).min_by(|a, b| loss(a).total_cmp(&loss(b))).unwrap()
    };
    assert_eq!((least(QualityTarget::Share), least(QualityTarget::Label)), (50, 99));

    let (share, whole) = (sums(QualityTarget::Share, 0.8), sums(QualityTarget::Label, 0.8));
    // Both voxels have the weight of successes.
    let expected = -3.0 * (0.8_f64.ln() + 0.2_f64.ln());
    assert!((share.quality - expected).abs() < 1e-5, "{}", share.quality);
    assert!(share.rotation > 1.0 && share.width > 0.1);
    assert_eq!(
        (share.rotation, share.width),
        (whole.rotation, whole.width),
        "rotation and width do not depend on the share"
    );
    assert_eq!((share.accuracy(), share.recall()), (1.0, 1.0), "successes are those of the label");
}

#[test]
fn the_quality_converges_to_the_share() {
    let mut scenes: Vec<_> = (0..8).map(|seed| support::scene(seed, N)).collect();
    scenes.iter_mut().for_each(|scene| scene.trials[0].share = 0.5);
    let last_loss = |quality: QualityTarget| {
        let settings = TrainingSettings { quality, batch: 8, learning_rate: 1e-3, warmup: 10, ..settings() };
        let mut trainer = trainer(Dataset::new(scenes.clone()).unwrap(), &settings, EXECUTION);
        (0..80).map(|_| epoch(&mut trainer)).last().unwrap().loss_quality
    };
    let (label, share) = (last_loss(QualityTarget::Label), last_loss(QualityTarget::Share));
    // Half of the voxels are successes; their smallest possible loss is ln 2.
    let least = 0.5 * std::f64::consts::LN_2;
    assert!(label < 0.05 && (least - 1e-4..least + 0.05).contains(&share), "{label}, {share}");
}

#[test]
fn the_voxel_of_a_grasp_depends_on_the_voxel_origin() {
    let at = |x: f64, y: f64, z: f64| Trial {
        position: Point3::new(x, y, z),
        rotation: UnitQuaternion::identity(),
        width: 4.0,
        success: true,
        yaws: 0,
        share: 1.0,
        clearance: 0.0,
    };
    let voxel = |x: i64, y: i64, z: i64| (x * 4 + y) * 4 + z;
    let voxels = |label: &Trial, origin| {
        let mut targets = Targets::default();
        targets.push(2, label, 4, origin, QualityTarget::Label);
        targets.voxels().iter().map(|voxel| voxel - 2 * 64).collect::<Vec<_>>()
    };
    assert_eq!(voxels(&at(1.2, 0.7, 3.4), VoxelOrigin::Center), [voxel(1, 0, 3)]);
    assert_eq!(voxels(&at(1.2, 0.7, 3.4), VoxelOrigin::Corner), [voxel(1, 1, 3)]);
    assert_eq!(voxels(&at(1.2, 0.7, 3.6), VoxelOrigin::Center), [voxel(1, 0, 3)]);
    assert!(voxels(&at(1.2, 0.7, 3.6), VoxelOrigin::Corner).is_empty(), "the nearest index is outside");
    assert!(voxels(&at(1.2, -0.7, 3.6), VoxelOrigin::Center).is_empty());
}
