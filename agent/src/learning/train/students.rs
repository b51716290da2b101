//! Which student the settings ask for.

use crate::config::{AgentConfig, LearnerKind};
use crate::estimation::first_belief::first_belief;
use crate::learning::checkpoint::Contents;
use crate::learning::student::decisions::{Decisions, DecisionsStudent};
use crate::learning::student::filter::FilterStudent;
use crate::learning::student::network::{self, NetworkStudent};
use crate::learning::student::{Student, Worlds};
use crate::learning::train::training::Training;
use anyhow::{Context, Result, bail};
use emberwatch_belief::estimation::BayesFilter;
use emberwatch_belief::estimation::parameters::Dimensions;
use protocol::control::CoverageRule;
use protocol::{Client, Model};
use std::path::Path;

/// What the settings say that learns, going on from a checkpoint's contents if there are any.
pub fn student(
    training: &Training,
    client: &Client,
    contents: Option<&Contents>,
    place: &Path,
) -> Result<Box<dyn Student>> {
    let (info, config) = (client.info(), &training.config);
    let worlds = Worlds {
        shape: client.shape(),
        n_observations: info.n_observations,
        n_moves: info.n_moves,
        numbers: client.robots(),
    };
    let of_file = || format!("checkpoint {}", place.display());
    Ok(match config.learner {
        LearnerKind::Filter | LearnerKind::OwnFilter => {
            let dimensions = dimensions(config, worlds.n_observations)?;
            Box::new(match contents {
                Some(contents) => FilterStudent::resume(contents, dimensions, worlds, config)
                    .with_context(of_file)?,
                None => FilterStudent::new(dimensions, worlds, config),
            })
        }
        LearnerKind::Autoencoder => {
            let mut progress = network::Progress::first(&worlds, config, &training.device)?;
            if let Some(contents) = contents {
                progress.load(contents).with_context(of_file)?;
            }
            let full_frames = config.autoencoder.full_frames;
            let wants = progress.position.iterations < full_frames && !training.freeze;
            if wants && info.coverage == CoverageRule::Path {
                bail!(
                    "autoencoder.full_frames: {full_frames} frames that show every cell need a server with \
                     --coverage client or full, or the setting 0"
                );
            }
            Box::new(NetworkStudent::new(progress, worlds, config))
        }
        LearnerKind::Decisions => {
            let model = info.model.as_deref().context(
                "learning decisions needs the server's model: start it with --reveal-model true, not with --states",
            )?;
            let model = Model::from_toml(model)?;
            let mut decisions = Decisions::first(&model, &config.decisions, config.seed);
            if let Some(contents) = contents {
                decisions.load(contents).with_context(of_file)?;
            }
            let prior = config.prior(info.burn_in);
            let prior = first_belief(prior, &model, worlds.shape, config.seed)?;
            let filter = BayesFilter::known(&model, prior)?;
            Box::new(DecisionsStudent::new(
                decisions, filter, &model, worlds, config,
            ))
        }
    })
}

fn dimensions(config: &AgentConfig, n_observations: usize) -> Result<Dimensions> {
    let learning = config.learning;
    let n_states = match learning.states {
        0 => n_observations,
        states => states,
    };
    let kernel = (learning.kernel[0], learning.kernel[1]);
    let dimensions = Dimensions {
        n_states,
        n_observations,
        kernel,
        sees_own_state: config.learner == LearnerKind::OwnFilter,
    };
    Ok(dimensions.check()?)
}
