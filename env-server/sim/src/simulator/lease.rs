//! Leases: which client may fly which robots, and until when. The functions here are pure: the time and new tokens are
//! arguments.
//!
//! A lease covers robots with consecutive numbers. It ends when it is released, expires or loses its last robot to a
//! takeover, or when its client's connection or process ends. A robot taken from a lease stays lost to that lease, even
//! when the robot becomes free again.

use emberwatch_messages::message::Status;
use std::collections::{HashMap, HashSet, VecDeque};
use std::ops::Range;
use std::time::{Duration, Instant};

/// Number of ended leases that are remembered, so that an ended lease can be distinguished from one that never existed.
const REMEMBERED: usize = 1024;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClientId {
    pub node: u128,
    pub pid: u32,
}

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    pub token: u64,
    pub client: ClientId,
    /// The robots for which the lease was acquired.
    pub robots: Range<usize>,
    /// The lease expires this long after its last use.
    pub time_to_live: Duration,
    expires: Instant,
    /// The process that last took over one of the lease's robots.
    taken_by: Option<u32>,
    /// Number of the lease's requests that wait for resets or for other clients' paths. While it is positive, the lease
    /// cannot expire.
    n_waiting: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal {
    pub status: Status,
    pub detail: u64,
}

#[derive(Debug)]
pub struct Leases {
    holders: Vec<Option<u64>>,
    live: HashMap<u64, Lease>,
    ended: VecDeque<Ended>,
}

#[derive(Debug)]
struct Ended {
    token: u64,
    first_robot: usize,
    /// The process that took over the last robot, if that takeover ended the lease.
    taken_by: Option<u32>,
}

#[derive(Debug, Clone)]
pub struct Claim {
    pub client: ClientId,
    pub robots: Range<usize>,
    pub takeover: bool,
    /// Time after its last use at which the lease expires.
    pub time_to_live: Duration,
}

impl Refusal {
    pub fn new(status: Status, detail: u64) -> Self {
        Self { status, detail }
    }
}

impl Lease {
    fn has_expired(&self, now: Instant) -> bool {
        self.n_waiting == 0 && self.expires <= now
    }
}

impl Leases {
    pub fn new(n_robots: usize) -> Self {
        Self {
            holders: vec![None; n_robots],
            live: HashMap::new(),
            ended: VecDeque::new(),
        }
    }

    /// Grants a lease under a new token. Robots that the client already holds move to the new lease.
    ///
    /// # Errors
    /// If a robot does not exist, or another client holds one and the claim is not a takeover.
    pub fn acquire(&mut self, now: Instant, claim: Claim, token: u64) -> Result<&Lease, Refusal> {
        self.check_robots(&claim.robots)?;
        self.expire(now);
        let others = claim.robots.clone().filter_map(|robot| self.holder(robot));
        let other = others
            .into_iter()
            .find(|holder| holder.client != claim.client);
        if let Some(holder) = other.filter(|_| !claim.takeover) {
            return Err(Refusal::new(Status::Busy, holder.client.pid.into()));
        }
        for robot in claim.robots.clone() {
            let former = self.holders[robot].replace(token);
            if let Some(former) = former.and_then(|token| self.live.get_mut(&token)) {
                former.taken_by = Some(claim.client.pid);
            }
        }
        self.forget_empty_leases();
        let Claim {
            client,
            robots,
            time_to_live,
            ..
        } = claim;
        let lease = Lease {
            token,
            client,
            robots,
            time_to_live,
            expires: now + time_to_live,
            taken_by: None,
            n_waiting: 0,
        };
        Ok(self.live.entry(token).or_insert(lease))
    }

    /// Checks that a client may fly robots under a lease, and extends the lease.
    pub fn use_lease(
        &mut self,
        now: Instant,
        token: u64,
        client: ClientId,
        robots: &Range<usize>,
    ) -> Result<(), Refusal> {
        self.check_robots(robots)?;
        let missing = self.holders[robots.clone()]
            .iter()
            .position(|holder| *holder != Some(token));
        if let Some(first) = missing {
            return Err(self.not_held(token, client, robots.start + first));
        }
        self.renew(now, token, client).map(|_| ())
    }

    pub fn renew(&mut self, now: Instant, token: u64, client: ClientId) -> Result<&Lease, Refusal> {
        let is_live = |lease: &&mut Lease| lease.client == client && !lease.has_expired(now);
        if self.live.get_mut(&token).filter(is_live).is_none() {
            let robot = self.first_robot(token).unwrap_or(0);
            return Err(self.not_held(token, client, robot));
        }
        let lease = self.live.get_mut(&token).expect("invariant: found above");
        lease.expires = now + lease.time_to_live;
        Ok(lease)
    }

    /// Checks that a client may reset or replace the world of these robots under a lease, and extends the lease.
    pub fn use_world(
        &mut self,
        now: Instant,
        token: u64,
        client: ClientId,
        robots: Range<usize>,
    ) -> Result<(), Refusal> {
        let own = robots
            .clone()
            .find(|&robot| self.holders[robot] == Some(token))
            .unwrap_or(robots.start);
        self.use_lease(now, token, client, &(own..own + 1))?;
        let mut holders = robots.filter_map(|robot| self.holder(robot));
        match holders.find(|holder| holder.client != client) {
            Some(other) => Err(Refusal::new(Status::Busy, other.client.pid.into())),
            None => Ok(()),
        }
    }

    pub fn begin_wait(&mut self, token: u64) {
        if let Some(lease) = self.live.get_mut(&token) {
            lease.n_waiting += 1;
        }
    }

    /// Ends a wait counted by [`Self::begin_wait`]. This counts as a use of the lease at `now`.
    pub fn end_wait(&mut self, now: Instant, token: u64) {
        if let Some(lease) = self.live.get_mut(&token) {
            lease.n_waiting = lease.n_waiting.saturating_sub(1);
            lease.expires = now + lease.time_to_live;
        }
    }

    pub fn release(&mut self, now: Instant, token: u64, client: ClientId) -> Result<(), Refusal> {
        self.renew(now, token, client)?;
        self.end(token);
        Ok(())
    }

    pub fn expire(&mut self, now: Instant) -> Vec<Lease> {
        self.end_where(|lease| lease.has_expired(now))
    }

    pub fn end_of_process(&mut self, pid: u32) -> Vec<Lease> {
        self.end_where(|lease| lease.client.pid == pid)
    }

    /// Ends and returns the leases whose client's node is not in `nodes`.
    pub fn end_of_nodes_except(&mut self, nodes: &HashSet<u128>) -> Vec<Lease> {
        self.end_where(|lease| !nodes.contains(&lease.client.node))
    }

    pub fn robots_held(&self, token: u64) -> Vec<usize> {
        let held = |robot: &usize| self.holders[*robot] == Some(token);
        let lease = self.live.get(&token);
        lease.map_or_else(Vec::new, |lease| {
            lease.robots.clone().filter(held).collect()
        })
    }

    pub fn holder(&self, robot: usize) -> Option<&Lease> {
        self.holders[robot].and_then(|token| self.live.get(&token))
    }

    /// Returns a mask of the held robots in a range of at most 64: bit i stands for the i-th robot of the range.
    pub fn held(&self, robots: Range<usize>) -> u64 {
        let holders = self.holders[robots].iter();
        bits(holders.map(Option::is_some))
    }

    /// Returns a mask of the robots that a lease holds, in a range of at most 64.
    pub fn held_under(&self, token: u64, robots: Range<usize>) -> u64 {
        let holders = self.holders[robots].iter();
        bits(holders.map(|holder| *holder == Some(token)))
    }

    fn check_robots(&self, robots: &Range<usize>) -> Result<(), Refusal> {
        if robots.start < robots.end && robots.end <= self.holders.len() {
            return Ok(());
        }
        Err(Refusal::new(Status::NoSuchRobot, self.holders.len() as u64))
    }

    fn first_robot(&self, token: u64) -> Option<usize> {
        let live = self.live.get(&token).map(|lease| lease.robots.start);
        live.or_else(|| self.ended(token).map(|ended| ended.first_robot))
    }

    fn ended(&self, token: u64) -> Option<&Ended> {
        self.ended.iter().find(|ended| ended.token == token)
    }

    pub fn not_held(&self, token: u64, client: ClientId, robot: usize) -> Refusal {
        let is_own = |lease: &&Lease| lease.client == client && lease.robots.contains(&robot);
        let holder = self.holder(robot).map(|holder| holder.client.pid);
        let taken_by = match (self.live.get(&token).filter(is_own), self.ended(token)) {
            (Some(_), _) if self.holders[robot] == Some(token) => None, // The lease has expired.
            (Some(lease), _) => holder.or(lease.taken_by),
            (None, Some(ended)) => ended.taken_by.or(holder),
            (None, None) => return Refusal::new(Status::NoLease, robot as u64),
        };
        Refusal::new(Status::LeaseLost, taken_by.map_or(0, u64::from))
    }

    fn end_where(&mut self, is_over: impl Fn(&Lease) -> bool) -> Vec<Lease> {
        let over: Vec<u64> = self
            .live
            .values()
            .filter(|lease| is_over(lease))
            .map(|lease| lease.token)
            .collect();
        over.into_iter()
            .filter_map(|token| self.end(token))
            .collect()
    }

    fn end(&mut self, token: u64) -> Option<Lease> {
        let lease = self.live.remove(&token)?;
        let mut held = false;
        for holder in &mut self.holders[lease.robots.clone()] {
            held |= *holder == Some(token);
            holder.take_if(|holder| *holder == token);
        }
        if self.ended.len() == REMEMBERED {
            self.ended.pop_front();
        }
        self.ended.push_back(Ended {
            token,
            first_robot: lease.robots.start,
            taken_by: lease.taken_by.filter(|_| !held),
        });
        Some(lease)
    }

    fn forget_empty_leases(&mut self) {
        let holders = self.holders.clone();
        let is_empty = |lease: &Lease| {
            holders[lease.robots.clone()]
                .iter()
                .all(|holder| *holder != Some(lease.token))
        };
        self.end_where(is_empty);
    }
}

fn bits(bits: impl Iterator<Item = bool>) -> u64 {
    bits.enumerate()
        .fold(0, |mask, (index, bit)| mask | u64::from(bit) << index)
}
