use std::borrow::Cow;
use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::path::Path;

use anyhow::Context;
use grasp::gpd::{Cloud, Image, Params, by_sample, is_on_an_object, ranked, scored};
use grasp::{DecodeParams, Decoded, Fusion, Grasp, Hand, SurfacePoint, Volume, select};
use grasp_models::{Backend, Classifier, Entry, Network, Options};
use grasp_proto::Asked;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use crate::engine::EngineError;

/// The height above the table below which no hand is sent, metres: the noise of a camera.
const ABOVE_TABLE: f64 = 0.002;

/// How much narrower than the hand's opening something must be, metres, that GPD closes on.
const PLAY: f64 = 0.01;

/// A success is the likelier.
const GPD_THRESHOLD: f32 = 0.5;

/// Its quality is a rank, and says nothing.
const SHAF_THRESHOLD: f32 = 1e-6;

/// Candidates that are scored before it is asked again whether anybody waits for them.
const SCORED_AT_ONCE: usize = 64;

/// What can be asked for by name, and what it is made from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Source {
    /// A network, from volumes to maps.
    Network(Entry),
    /// Places where the hand fits into a point cloud, scored by a classifier.
    Gpd(Entry),
    /// The highest of those places.
    Shaf,
}

/// What a planner looks at.
#[derive(Debug)]
pub(crate) struct Scene {
    /// What networks read, and what hands must not touch.
    pub volume: Volume,
    /// What was seen, in the volume's own frame, where that is known more finely than by the volume.
    pub sights: Option<Vec<SurfacePoint>>,
}

/// A planner, ready to run. A thread has it for itself.
pub(crate) enum Planner {
    Network(Network),
    Classical(Classical),
}

/// A planner on the point cloud.
pub(crate) enum Classical {
    Gpd(Classifier),
    Shaf,
}

impl Source {
    pub fn name(&self) -> &str {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => &entry.metadata.name,
            Self::Shaf => "shaf",
        }
    }

    pub fn version(&self) -> &str {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => &entry.metadata.version,
            Self::Shaf => "1",
        }
    }

    /// Of its file; empty if it has none.
    pub fn sha256(&self) -> &str {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => &entry.sha256,
            Self::Shaf => "",
        }
    }

    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => Some(&entry.path),
            Self::Shaf => None,
        }
    }

    pub fn provenance(&self) -> BTreeMap<String, String> {
        match self {
            Self::Network(entry) | Self::Gpd(entry) => entry.metadata.provenance.clone(),
            Self::Shaf => [("method".to_owned(), "the highest place where the hand fits".to_owned())].into(),
        }
    }

    /// What it says of the volumes that it reads, if it is a network.
    pub fn network(&self) -> Option<&Entry> {
        match self {
            Self::Network(entry) => Some(entry),
            Self::Gpd(_) | Self::Shaf => None,
        }
    }

    /// Which of two versions of a name is the older.
    pub fn by_version(&self, other: &Self) -> Ordering {
        match (self, other) {
            (Self::Network(one) | Self::Gpd(one), Self::Network(other) | Self::Gpd(other)) => one.by_version(other),
            _ => Ordering::Equal,
        }
    }

    /// How its grasps are chosen, unless a request says otherwise.
    pub fn decode_params(&self) -> DecodeParams {
        match self {
            Self::Network(entry) => entry.metadata.decode_params(),
            Self::Gpd(_) => DecodeParams { threshold: GPD_THRESHOLD, ..DecodeParams::default() },
            Self::Shaf => DecodeParams { threshold: SHAF_THRESHOLD, ..DecodeParams::default() },
        }
    }

    /// Loads as many as there are sessions.
    pub fn load(&self, options: &Options, count: usize) -> anyhow::Result<(Vec<Planner>, Backend)> {
        Ok(match self {
            Self::Network(entry) => {
                let networks = Network::load_several(entry, options, count)?;
                let backend = networks.first().context("at least one session is wanted")?.backend();
                (networks.into_iter().map(Planner::Network).collect(), backend)
            }
            Self::Gpd(entry) => {
                let classifiers = Classifier::load_several(entry, options, count)?.into_iter().map(Classical::Gpd);
                (classifiers.map(Planner::Classical).collect(), Backend::REFERENCE)
            }
            Self::Shaf => ((0..count).map(|_| Planner::Classical(Classical::Shaf)).collect(), Backend::REFERENCE),
        })
    }
}

impl Classical {
    /// The finest volume that is looked at, voxels along an edge: in a cube of 0.3 m, as fine as the cloud is thinned to.
    pub const MAX_RESOLUTION: usize = 100;

    /// Looks for places where the hand fits, the same ones whenever it is asked again; for as long as it is `wanted`.
    pub fn plan(
        &mut self,
        scene: &Scene,
        asked: &Asked,
        params: &DecodeParams,
        wanted: impl Fn() -> bool,
    ) -> Result<Decoded, EngineError> {
        let volume = &scene.volume;
        let size = volume.resolution() as f64 * volume.voxel_size();
        let table = asked.table.unwrap_or(0.0);
        let sights = match &scene.sights {
            Some(sights) => Cow::Borrowed(sights),
            None => Cow::Owned(Fusion::of(volume).surface()),
        };
        let on_objects: Vec<SurfacePoint> =
            sights.iter().filter(|point| is_on_an_object(&point.position, size, table)).copied().collect();
        let elsewhere = sights.len() - on_objects.len();
        let cloud = Cloud::new(on_objects);
        let hand = asked.hand.unwrap_or(Hand::GPD);
        let aperture = PLAY..=(2.0 * hand.half_opening() - PLAY);
        let params_of_hands = Params { hand, aperture, ..Params::above(table + ABOVE_TABLE) };
        let (mut found, mut unfit) = (Vec::new(), 0);
        for of_sample in by_sample(&cloud, &params_of_hands, &mut ChaCha8Rng::seed_from_u64(0)) {
            if !wanted() {
                return Err(EngineError::Expired);
            }
            unfit += params_of_hands.rotations - of_sample.len();
            found.extend(of_sample);
        }
        let grasps = match self {
            Self::Shaf => ranked(found),
            Self::Gpd(classifier) => {
                let mut scores = Vec::with_capacity(found.len());
                for some in found.chunks(SCORED_AT_ONCE) {
                    if !wanted() {
                        return Err(EngineError::Expired);
                    }
                    let images: Vec<Image> = some.iter().map(|candidate| Image::of(&cloud, candidate)).collect();
                    scores.extend(classifier.score(&images)?);
                }
                scored(&found, &scores)
            }
        };
        let in_frame: Vec<Grasp> =
            grasps.into_iter().map(|grasp| Grasp { pose: volume.pose() * grasp.pose, ..grasp }).collect();
        let mut decoded = select(&in_frame, volume, params);
        decoded.dropped.mask += elsewhere;
        decoded.dropped.collision += unfit;
        Ok(decoded)
    }
}
