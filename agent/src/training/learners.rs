//! Which learner the settings ask for.

use crate::training::spec::TrainingSpec;
use anyhow::{Context, Result, bail, ensure};
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::parameters::{Dimensions, n_zones};
use emberwatch_learning::checkpoint::Contents;
use emberwatch_learning::config::{AgentConfig, LearnerKind};
use emberwatch_learning::estimation::first_belief::first_belief;
use emberwatch_learning::learners::decisions::{Base, DecisionsLearner};
use emberwatch_learning::learners::filter::FilterLearner;
use emberwatch_learning::learners::network::{self, NetworkLearner};
use emberwatch_learning::learners::neural::NeuralLearner;
use emberwatch_learning::learners::{Learner, Worlds};
use emberwatch_protocol::control::{CoverageRule, ServerInfo};
use emberwatch_protocol::{Client, Grid, Model, Shape};
use std::path::Path;
use std::sync::Arc;

/// What the settings say that learns, going on from a checkpoint's contents if there are any.
pub fn learner(
    spec: &TrainingSpec,
    client: &Client,
    contents: Option<&Contents>,
    place: &Path,
) -> Result<Box<dyn Learner>> {
    let (info, config) = (client.info(), &spec.config);
    let worlds = Worlds {
        airspace: info.airspace().map_err(anyhow::Error::msg)?,
        zones: zones(info)?,
        n_observations: info.n_observations,
        n_moves: info.n_moves,
        numbers: client.robots(),
    };
    let n_rings = worlds.airspace.n_rings();
    let is_network = matches!(
        config.learner,
        LearnerKind::Neural | LearnerKind::Autoencoder
    );
    ensure!(
        n_rings == 1 || !is_network,
        "learner: expected a sensor with one observation matrix, as networks learn such alone, got {n_rings}"
    );
    let of_file = || format!("checkpoint {}", place.display());
    Ok(match config.learner {
        LearnerKind::Filter | LearnerKind::OwnFilter => {
            let dimensions = dimensions(config, &worlds)?;
            Box::new(match contents {
                Some(contents) => FilterLearner::resume(contents, dimensions, worlds, config)
                    .with_context(of_file)?,
                None => FilterLearner::new(dimensions, worlds, config),
            })
        }
        LearnerKind::Neural => {
            let filter = spec.learned.filter.as_ref();
            let learner = NeuralLearner::new(contents, filter, worlds, config, &spec.device);
            Box::new(learner.with_context(of_file)?)
        }
        LearnerKind::Autoencoder => {
            let mut progress = network::Progress::first(&worlds, config, &spec.device)?;
            if let Some(contents) = contents {
                progress.load(contents).with_context(of_file)?;
            }
            check_full_frames(&progress, spec, info)?;
            check_window(spec, info)?;
            Box::new(NetworkLearner::new(progress, worlds, config))
        }
        LearnerKind::Decisions => {
            let saved =
                contents.map(|contents| Base::saved(contents, worlds.shape(), &spec.device));
            let base = match saved.transpose().with_context(of_file)?.flatten() {
                Some(base) => base,
                None => base(spec, info, worlds.shape())?,
            };
            base.check_world(&worlds.form())?;
            let learner = DecisionsLearner::new(base, contents, worlds, config);
            Box::new(learner.with_context(of_file)?)
        }
    })
}

/// Refuses a server without the first frames that the settings ask for, which show every cell.
fn check_full_frames(
    progress: &network::Progress,
    spec: &TrainingSpec,
    info: &ServerInfo,
) -> Result<()> {
    let full_frames = spec.config.autoencoder.full_frames;
    let wants = progress.position.iterations < full_frames && !spec.freeze;
    if wants && info.coverage == CoverageRule::Path {
        bail!(
            "autoencoder.full_frames: {full_frames} frames that show every cell need a server with --coverage client \
             or full, or the setting 0"
        );
    }
    Ok(())
}

/// Refuses episodes that are too short for a window, from which nothing could be learned.
fn check_window(spec: &TrainingSpec, info: &ServerInfo) -> Result<()> {
    // Recorded worlds may have longer episodes than their shortest.
    let is_cut = info.max_steps > 0 && info.recorded_world.is_none();
    let (window, n_frames) = (
        spec.config.autoencoder.window as u64,
        info.max_steps.saturating_add(1),
    );
    ensure!(
        spec.freeze || !is_cut || window <= n_frames,
        "autoencoder.window: expected at most the {n_frames} frames of an episode (--max-steps of the server), got \
         {window}"
    );
    Ok(())
}

/// What keeps the beliefs that decisions are learned on: what was learned, or the filter of the server's model.
fn base(spec: &TrainingSpec, info: &ServerInfo, shape: Shape) -> Result<Base> {
    let (kind, config) = (spec.config.decisions.estimator, &spec.config);
    if kind.is_learned() {
        let belief = spec.learned.belief(kind);
        let belief = belief.context("decisions: expected a checkpoint of a belief, got none")?;
        return Ok(Base::learned(kind, belief, shape));
    }
    let model = info.model.as_deref().with_context(|| {
        format!(
            "decisions on the belief of {} need the server's model: start it with --reveal-model true, not with \
             --states",
            kind.label()
        )
    })?;
    let model = Model::from_toml(model)?;
    let prior = first_belief(config.prior(info.burn_in), &model, shape, config.seed)?;
    let filter = BayesFilter::known(&model, prior)?;
    Ok(Base::known(kind, filter, &model))
}

fn zones(info: &ServerInfo) -> Result<Option<Arc<Grid<u8>>>> {
    let shape = info.shape()?;
    let map = info.zones.as_ref().map(|zones| zones.zone_map(shape));
    let map = map.transpose().map_err(anyhow::Error::msg)?;
    // Of one zone, all cells are alike.
    Ok(map
        .filter(|map| map.iter().any(|&zone| zone > 0))
        .map(Arc::new))
}

fn dimensions(config: &AgentConfig, worlds: &Worlds) -> Result<Dimensions> {
    let (learning, n_rings) = (config.learning, worlds.airspace.n_rings());
    let n_states = match learning.states {
        0 => worlds.n_observations / n_rings,
        states => states,
    };
    let kernel = (learning.kernel[0], learning.kernel[1]);
    let dimensions = Dimensions {
        n_states,
        n_observations: worlds.n_observations,
        kernel,
        sees_own_state: config.learner == LearnerKind::OwnFilter,
        n_zones: worlds.zones.as_deref().map_or(0, n_zones),
        n_matrices: n_rings,
    };
    Ok(dimensions.check()?)
}
