//! Films and stills of a recording: what was hidden, what the robot saw, and what the known model's filter
//! makes of it.
//!
//! The file is read twice: once for what there is to show, once to show it. [`story`] tells steps,
//! [`scenes`] adds beliefs, [`page`] draws, [`encoder`] makes a file of it. There is no MP4, as there is no
//! encoder for it in pure Rust that is kept up.

mod colors;
mod encoder;
mod legend;
mod page;
mod pen;
mod scenes;
mod story;
mod survey;
#[cfg(test)]
mod tests;

pub use self::encoder::{EncodeError, Format};
pub use self::scenes::Selection;
pub use self::story::StoryError;

use self::encoder::{MOST_PIXELS, Shot, encode};
use self::page::Page;
use self::scenes::{Scene, Scenes};
use self::story::Story;
use self::survey::Survey;
use crate::config::AgentConfig;
use crate::estimator::ZeroEvidence;
use crate::report::{ReportError, replace_file};
use protocol::control::ServerInfo;
use protocol::grid::ShapeError;
use protocol::model::ModelError;
use protocol::recording::{Reader, RecordingError};
use protocol::{Model, Shape};
use std::collections::BTreeSet;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Most pixels of a picture: some are held at a time.
const MOST_AREA: usize = 1 << 26;

/// How long the last picture and that of a gap are shown at least, hundredths of a second.
const PAUSE: u16 = 100;

/// What to make of a recording.
#[derive(Debug, Clone)]
pub struct Order {
    /// The recording.
    pub recording: PathBuf,
    /// The world.
    pub world: u32,
    /// The file to make.
    pub out: PathBuf,
    /// What it is to show.
    pub product: Product,
    /// Pixels of a cell's side; `None`: as the grid asks for.
    pub scale: Option<usize>,
    /// The model of a server that hid it.
    pub model: Option<Model>,
    /// Settings of the first belief.
    pub config: AgentConfig,
}

/// A kind of picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Product {
    /// Many that move.
    Film {
        /// As what.
        format: Format,
        /// Which steps.
        selection: Selection,
        /// How long each is shown, hundredths of a second.
        centis: u16,
    },
    /// One step.
    Still {
        /// Which.
        step: u64,
    },
}

/// What came of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Summary {
    /// Pictures.
    pub n_pictures: u32,
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Length of the file.
    pub n_bytes: usize,
    /// Steps between those of the recording that are not recorded.
    pub n_lost: u64,
}

/// Why there is no film.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FilmError {
    /// The recording cannot be read.
    #[error("recording {}: {problem}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: RecordingError,
    },
    /// A sample that no server publishes.
    #[error("recording {}: {problem}", path.display())]
    Sample {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: StoryError,
    },
    /// The same, when it was read again.
    #[error(transparent)]
    Story(#[from] StoryError),
    /// A world that is not in the recording.
    #[error("--world: expected one of the recorded worlds {known:?}, got {got}")]
    World {
        /// Those with frames.
        known: BTreeSet<u32>,
        /// The one asked for.
        got: u32,
    },
    /// Steps that are not in the recording.
    #[error("{flag}: expected one of the recorded steps {known}, got {got}")]
    Steps {
        /// Who asks.
        flag: &'static str,
        /// Those there are.
        known: String,
        /// Those asked for.
        got: String,
    },
    /// A recording that holds no model.
    #[error("--model: expected the model of this recording, whose server hid it, got none")]
    NoModel,
    /// Another model than the recording's.
    #[error("--model: expected one with {expected} observations, as the recording has, got {got}")]
    OtherModel {
        /// Observations of the recording.
        expected: usize,
        /// Of the model.
        got: usize,
    },
    /// A model that cannot be simulated on the grid.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// A grid that no world has.
    #[error(transparent)]
    Shape(#[from] ShapeError),
    /// A frame that the model holds for impossible.
    #[error("step {step}: {problem}")]
    Evidence {
        /// Its step.
        step: u64,
        /// What is wrong.
        problem: ZeroEvidence,
    },
    /// Pictures that are too large.
    #[error(
        "--scale: expected pictures of at most {MOST_PIXELS} pixels a side and {MOST_AREA} in all, got {width} x {height}"
    )]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// Pictures that no file holds.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The file.
    #[error(transparent)]
    Report(#[from] ReportError),
}

/// Makes a film or a still.
///
/// # Errors
/// [`FilmError`]. A recording that is damaged or cut short is shown as far as it is good, with a warning.
pub fn film(order: &Order) -> Result<Summary, FilmError> {
    let survey = Survey::of(order)?;
    survey.warn(order);
    let model = known_model(&survey.server, order)?;
    let shape = Shape::new(survey.server.height, survey.server.width)?;
    // Four panels beside each other, before anything is drawn: a page is held as a whole.
    let scale = order.scale.unwrap_or(1);
    let panels = (
        shape.width().saturating_mul(4 * scale),
        shape.height().saturating_mul(scale),
    );
    check_size(panels)?;
    let page = Page::new(&model, shape, order.world, order.scale, survey.has_truth);
    let size = page.size();
    check_size(size)?;
    let story = Story::new(open(&order.recording)?, order.world);
    let selection = order.product.selection();
    let world = (&model, shape, survey.server.burn_in);
    let scenes = Scenes::new(story, &selection, world, &order.config)?;
    let bytes = match &order.product {
        Product::Film { format, centis, .. } => {
            let shots = shots(&page, scenes, (survey.n_pictures, *centis));
            let palette = page.colors().palette();
            encode(*format, size, palette, (survey.n_pictures, shots))?
        }
        Product::Still { .. } => still(&page, scenes)?,
    };
    replace_file(&order.out, "film", |path| std::fs::write(path, &bytes))?;
    Ok(Summary {
        n_pictures: survey.n_pictures,
        size,
        n_bytes: bytes.len(),
        n_lost: survey.n_lost,
    })
}

fn check_size((width, height): (usize, usize)) -> Result<(), FilmError> {
    match width.max(height) > MOST_PIXELS || width.saturating_mul(height) > MOST_AREA {
        true => Err(FilmError::Size { width, height }),
        false => Ok(()),
    }
}

/// The model that the recording's server revealed, or else the one given.
fn known_model(server: &ServerInfo, order: &Order) -> Result<Model, FilmError> {
    let model = match (&server.model, &order.model) {
        (Some(text), _) => Model::from_toml(text)?,
        (None, Some(model)) => model.clone(),
        (None, None) => return Err(FilmError::NoModel),
    };
    let (expected, got) = (server.n_observations, model.n_observations());
    match expected == got {
        true => Ok(model),
        false => Err(FilmError::OtherModel { expected, got }),
    }
}

/// Scenes drawn; the last one and those of gaps stay for a while.
fn shots(
    page: &Page<'_>,
    scenes: impl Iterator<Item = Result<Scene, FilmError>>,
    (n_pictures, centis): (u32, u16),
) -> impl Iterator<Item = Result<Shot, FilmError>> {
    let shot = move |(number, scene): (u32, Result<Scene, FilmError>)| {
        let scene = scene?;
        let stays = number == n_pictures || scene.n_lost > 0;
        Ok(Shot {
            picture: page.picture(&scene),
            centis: if stays { PAUSE.max(centis) } else { centis },
        })
    };
    (1..=n_pictures).zip(scenes).map(shot)
}

/// The first scene that is recorded.
fn still(
    page: &Page<'_>,
    scenes: impl Iterator<Item = Result<Scene, FilmError>>,
) -> Result<Vec<u8>, FilmError> {
    let mut scenes = scenes.filter(|scene| !scene.as_ref().is_ok_and(|scene| scene.n_lost > 0));
    let scene = scenes.next();
    let scene = scene.expect("invariant: the survey found the step")?;
    let png = page.picture(&scene).png(page.colors().palette());
    Ok(png.map_err(EncodeError::from)?)
}

impl Product {
    fn selection(&self) -> Selection {
        match self {
            Self::Film { selection, .. } => selection.clone(),
            Self::Still { step } => Selection {
                steps: *step..=*step,
                every: 1,
            },
        }
    }
}

/// The records of a file.
fn open(path: &Path) -> Result<Reader<BufReader<File>>, FilmError> {
    let open = || Reader::new(BufReader::new(File::open(path)?));
    open().map_err(|problem| FilmError::File {
        path: path.to_owned(),
        problem,
    })
}
