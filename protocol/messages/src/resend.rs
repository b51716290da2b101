//! Sends a step again until its worlds have moved: the loop of every client.

/// How [`until_moved`] ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Flown<A> {
    /// The answer to the step.
    Answered(A),
    /// What an observation showed after a step without an answer: the worlds have moved.
    Observed(A),
    /// The caller gave up before the worlds have moved.
    GivenUp,
}

/// Sends a step, and after each timeout looks whether its worlds have moved; if not, sends it again. A slow teammate is
/// waited for, a silent server is not.
///
/// `send` returns `None` if no answer came in time, `look` if the worlds have not moved since the first `send`.
///
/// # Errors
/// The first error of `send` or `look`.
pub fn until_moved<S, A, E>(
    client: &mut S,
    mut send: impl FnMut(&mut S) -> Result<Option<A>, E>,
    mut look: impl FnMut(&mut S) -> Result<Option<A>, E>,
    mut gives_up: impl FnMut() -> bool,
) -> Result<Flown<A>, E> {
    loop {
        if let Some(answer) = send(client)? {
            return Ok(Flown::Answered(answer));
        }
        if let Some(seen) = look(client)? {
            return Ok(Flown::Observed(seen));
        }
        if gives_up() {
            return Ok(Flown::GivenUp);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts sends and looks; the worlds have moved after `moves_at` looks.
    fn run(answers_at: usize, moves_at: usize, patience: usize) -> (Flown<()>, usize, usize) {
        let (mut n, mut left) = ((0, 0), patience);
        let flown = until_moved(
            &mut n,
            |n| {
                n.0 += 1;
                Ok::<_, ()>((n.0 == answers_at).then_some(()))
            },
            |n| {
                n.1 += 1;
                Ok((n.1 == moves_at).then_some(()))
            },
            || {
                left -= 1;
                left == 0
            },
        );
        (flown.expect("no error"), n.0, n.1)
    }

    #[test]
    fn an_answer_ends_it() {
        assert_eq!(run(1, 9, 9), (Flown::Answered(()), 1, 0));
        assert_eq!(run(3, 9, 9), (Flown::Answered(()), 3, 2));
    }

    #[test]
    fn moved_worlds_end_it_without_another_send() {
        assert_eq!(run(9, 2, 9), (Flown::Observed(()), 2, 2));
    }

    #[test]
    fn it_can_be_given_up() {
        assert_eq!(run(9, 9, 2), (Flown::GivenUp, 2, 2));
    }
}
