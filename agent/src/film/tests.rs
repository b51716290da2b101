//! Stories and scenes of records that are whole, lack something, or lie.

use super::scenes::{MOST_LOST, Scene, Scenes, Selection};
use super::story::{Beat, Link, Story, StoryError};
use crate::belief::Belief;
use crate::config::{AgentConfig, PriorKind};
use crate::estimator::BayesFilter;
use protocol::control::{CoverageRule, ServerInfo};
use protocol::message::{FrameHeader, StepResult, TruthHeader};
use protocol::observer::Sample;
use protocol::recording::{Event, Record, RecordingError};
use protocol::{Cell, Frame, Model, Shape};

/// Observed values of a frame of 2 x 3 cells.
const SEEN: [u8; 6] = [255, 0, 255, 2, 1, 255];

fn record(event: Event) -> Result<Record, RecordingError> {
    let (nanos, n_lost) = (0, 0);
    Ok(Record {
        nanos,
        n_lost,
        event,
    })
}

fn server() -> Event {
    Event::Server(Box::new(ServerInfo {
        protocol: 1,
        build: "0.1.0".into(),
        pid: 1,
        height: 2,
        width: 3,
        n_moves: 2,
        n_worlds: 2,
        n_observations: 3,
        observations: vec!["normal".into(), "latent".into(), "fire".into()],
        model: None,
        burn_in: 0,
        max_steps: 0,
        max_clients: 16,
        coverage: CoverageRule::Path,
        publish_truth: true,
        lease_millis: 30_000,
    }))
}

/// A step's frame: two moves from the first cell, right and down.
fn frame(world: u32, episode: u64, step: u64) -> Event {
    let result = StepResult {
        step,
        episode,
        seed: 7,
        reward: 2.0,
        row: 1,
        col: 1,
        ..StepResult::default()
    };
    let header = FrameHeader {
        version: 1,
        world,
        height: 2,
        width: 3,
        n_moves: 2,
        result,
        ..FrameHeader::default()
    };
    let payload = [&SEEN[..], &[3, 1]].concat();
    Event::Frame(Sample { header, payload })
}

fn truth(episode: u64, step: u64) -> Event {
    let header = TruthHeader {
        version: 1,
        episode,
        step,
        seed: 7,
        height: 2,
        width: 3,
        ..TruthHeader::default()
    };
    let payload = vec![step as u8 % 3; 6];
    Event::Truth(Sample { header, payload })
}

fn told(events: Vec<Event>) -> Vec<Beat> {
    let story = Story::new(events.into_iter().map(record), 0);
    story.collect::<Result<_, _>>().expect("a story")
}

fn scenes(events: Vec<Event>, selection: &Selection) -> Vec<Scene> {
    let story = Story::new(events.into_iter().map(record), 0);
    let shape = Shape::new(2, 3).expect("test shape");
    let config = AgentConfig {
        prior: PriorKind::Uniform,
        ..AgentConfig::default()
    };
    let model = Model::wildfire();
    let scenes = Scenes::new(story, selection, (&model, shape, 0), &config).expect("valid");
    scenes.collect::<Result<_, _>>().expect("scenes")
}

fn all() -> Selection {
    Selection {
        steps: 0..=u64::MAX,
        every: 1,
    }
}

#[test]
fn a_story_is_of_one_world_and_tells_each_step_once() {
    let events = vec![
        server(),
        // Hidden states may come well before their frame, or behind it.
        truth(0, 0),
        truth(0, 1),
        truth(0, 2),
        frame(0, 0, 1),
        frame(0, 0, 1),
        frame(1, 0, 5),
        frame(0, 0, 2),
        frame(0, 0, 6),
        truth(0, 6),
        truth(0, 7),
        frame(0, 1, 0),
        frame(0, 1, 1),
        server(),
        frame(0, 1, 2),
    ];
    let beats = told(events);
    let places: Vec<(u64, u64)> = beats
        .iter()
        .map(|beat| (beat.result.episode, beat.result.step))
        .collect();
    assert_eq!(places, [(0, 1), (0, 2), (0, 6), (1, 0), (1, 1), (1, 2)]);
    let links: Vec<Link> = beats.iter().map(|beat| beat.link).collect();
    let follows = |n_lost| Link::Follows { n_lost };
    let expected = [
        Link::Begins,
        follows(0),
        follows(3),
        Link::Begins,
        follows(0),
        Link::Begins,
    ];
    assert_eq!(links, expected);
    let truths = beats
        .iter()
        .map(|beat| beat.truth.as_ref().map(|truth| truth[[0, 0]]));
    let truths: Vec<Option<u8>> = truths.collect();
    assert_eq!(truths, [Some(1), Some(2), Some(0), None, None, None]);
    let cell = |row, col| Cell { row, col };
    assert_eq!(beats[0].path, [cell(0, 0), cell(0, 1), cell(1, 1)]);
}

#[test]
fn beliefs_are_those_of_the_filter_also_through_gaps() {
    let events = vec![server(), frame(0, 0, 0), frame(0, 0, 1), frame(0, 0, 4)];
    let scenes = scenes(events, &all());
    let shape = Shape::new(2, 3).expect("test shape");
    let seen = Frame::from_bytes(shape, 3, &SEEN).expect("a frame");
    let mut filter =
        BayesFilter::known(&Model::wildfire(), Belief::uniform(3, shape)).expect("valid");
    let mut expected = Vec::new();
    for n_predictions in [0, 1] {
        (0..n_predictions).for_each(|_| filter.predict());
        filter.correct(&seen).expect("possible");
        expected.push(filter.belief().clone());
    }
    // Of step 3, the last that is not recorded.
    (0..2).for_each(|_| filter.predict());
    expected.push(filter.belief().clone());
    filter.predict();
    filter.correct(&seen).expect("possible");
    expected.push(filter.belief().clone());
    let beliefs: Vec<Belief> = scenes.iter().map(|scene| scene.belief.clone()).collect();
    assert_eq!(beliefs, expected);
    let steps: Vec<(u64, u64)> = scenes.iter().map(|it| (it.step, it.n_lost)).collect();
    assert_eq!(steps, [(0, 0), (1, 0), (3, 2), (4, 0)]);
    assert_eq!((scenes[2].frame.as_ref(), scenes[2].reward), (None, None));
    assert_eq!((scenes[3].past.n_lost, scenes[3].past.mean()), (2, 2.0));
}

#[test]
fn beliefs_begin_anew_with_episodes_and_behind_long_gaps() {
    let far = 2 + MOST_LOST;
    let events = vec![
        server(),
        frame(0, 0, 0),
        frame(0, 0, 1),
        frame(0, 1, 0),
        frame(0, 1, far),
    ];
    let scenes = scenes(events, &all());
    assert_ne!(scenes[1].belief, scenes[0].belief);
    assert_eq!(scenes[2].belief, scenes[0].belief);
    assert_eq!(scenes[3].belief, scenes[0].belief);
    assert_eq!(scenes[3].past.since, far);
}

#[test]
fn what_is_left_out_still_counts() {
    let events = || vec![server(), frame(0, 0, 0), frame(0, 0, 1), frame(0, 0, 2)];
    let whole = scenes(events(), &all());
    let selection = Selection {
        steps: 0..=2,
        every: 2,
    };
    let some = scenes(events(), &selection);
    assert_eq!(some, [whole[0].clone(), whole[2].clone()]);
}

#[test]
fn samples_that_lie_are_refused() {
    let refused = |change: &dyn Fn(&mut Sample<FrameHeader>), words: &str| {
        let Event::Frame(mut sample) = frame(0, 0, 1) else {
            panic!("a frame");
        };
        change(&mut sample);
        let records = [server(), Event::Frame(sample)].map(record);
        let mut story = Story::new(records.into_iter(), 0);
        let error: StoryError = story.next().expect("an end").expect_err("a lie");
        assert!(error.to_string().contains(words), "{error}");
    };
    refused(&|sample| sample.header.start_row = 2, "(2, 0)");
    refused(&|sample| sample.payload[0] = 3, "got 3");
    refused(&|sample| sample.payload[7] = 9, "got 9");
}
