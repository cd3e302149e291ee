//! The order in which write tasks run.

use std::collections::VecDeque;
use std::time::Duration;

use tokio::time::Instant;

/// Largest number of tasks in one group commit. The first of them is answered only after the last has run.
pub(super) const GROUP_LIMIT: usize = 64;

/// The longest time for which tasks of bulk work wait for others. The others need the connection all the time if it comes to that.
pub(super) const LONGEST_BEHIND: Duration = Duration::from_secs(1);

/// Which write tasks run first. Tasks of the same priority run in the order in which they were queued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WritePriority {
    /// What somebody waits for.
    Prompt,
    /// Bulk work: it runs while nobody waits for anything else, but no later than about a second after it was queued.
    Bulk,
}

/// Tasks that run in one transaction, each with the time at which it was queued.
pub(super) type Group<T> = VecDeque<(Instant, T)>;

/// The tasks that wait.
pub(super) struct WriteQueue<T> {
    prompt: Group<T>,
    bulk: Group<T>,
    /// Number of senders who wait for an answer, and whose next task is still to come.
    senders: usize,
    /// Whether the last group was one of bulk tasks that were due although prompt ones waited: now it is the turn of those.
    bulk_came_first: bool,
}

/// What runs next.
#[derive(Debug, PartialEq, Eq)]
pub(super) enum Next<T> {
    /// Tasks of one priority.
    Group(WritePriority, Group<T>),
    /// Bulk tasks wait for senders, until this time at most.
    HeldBack(Instant),
    /// Nothing waits.
    Nothing,
}

impl<T> Default for WriteQueue<T> {
    fn default() -> Self {
        Self { prompt: VecDeque::new(), bulk: VecDeque::new(), senders: 0, bulk_came_first: false }
    }
}

impl<T> WriteQueue<T> {
    pub(super) fn push(&mut self, priority: WritePriority, task: T, now: Instant) {
        match priority {
            WritePriority::Prompt => self.prompt.push_back((now, task)),
            WritePriority::Bulk => self.bulk.push_back((now, task)),
        }
    }

    /// A sender waits for an answer from now on.
    pub(super) fn add_sender(&mut self) {
        self.senders += 1;
    }

    /// A sender has its answer. Returns whether bulk tasks have waited for it.
    pub(super) fn remove_sender(&mut self) -> bool {
        self.senders -= 1;
        self.senders == 0 && !self.bulk.is_empty()
    }

    /// Whether somebody waits for something else than bulk tasks.
    pub(super) fn is_prompt(&self) -> bool {
        self.senders > 0 || !self.prompt.is_empty()
    }

    /// Takes the tasks of the next group commit.
    pub(super) fn next(&mut self, now: Instant) -> Next<T> {
        let due = self.bulk.front().map(|(since, _)| *since + LONGEST_BEHIND);
        let is_due = due.is_some_and(|due| now >= due);
        let (priority, queue) = match due {
            _ if !self.prompt.is_empty() && (!is_due || self.bulk_came_first) => {
                (WritePriority::Prompt, &mut self.prompt)
            }
            None => return Next::Nothing,
            Some(due) if self.senders > 0 && !is_due => return Next::HeldBack(due),
            Some(_) => (WritePriority::Bulk, &mut self.bulk),
        };
        let count = queue.len().min(GROUP_LIMIT);
        let group = queue.drain(..count).collect();
        self.bulk_came_first = priority == WritePriority::Bulk && !self.prompt.is_empty();
        Next::Group(priority, group)
    }

    /// Puts bulk tasks back that were taken and have not run: they are the first of their queue.
    pub(super) fn put_back(&mut self, mut group: Group<T>) {
        group.append(&mut self.bulk);
        self.bulk = group;
    }
}

#[cfg(test)]
mod tests {
    use super::WritePriority::{Bulk, Prompt};
    use super::*;

    fn taken(next: Next<usize>) -> (WritePriority, Vec<usize>) {
        let Next::Group(priority, group) = next else { panic!("{next:?}") };
        (priority, group.into_iter().map(|(_, task)| task).collect())
    }

    #[test]
    fn prompt_tasks_run_first_and_each_kind_in_its_order() {
        let (mut queue, now) = (WriteQueue::default(), Instant::now());
        for (task, priority) in [Bulk, Prompt, Bulk, Prompt, Bulk].into_iter().enumerate() {
            queue.push(priority, task, now);
        }
        assert_eq!(taken(queue.next(now)), (Prompt, vec![1, 3]));
        let Next::Group(Bulk, mut group) = queue.next(now) else { panic!("they wait") };
        assert_eq!(group.pop_front().map(|(_, task)| task), Some(0));
        // A prompt task arrives, and the others are held back; further ones are queued behind them.
        queue.push(Prompt, 5, now);
        queue.push(Bulk, 6, now);
        assert!(queue.is_prompt());
        queue.put_back(group);
        assert_eq!(taken(queue.next(now)), (Prompt, vec![5]));
        assert!(!queue.is_prompt());
        assert_eq!(taken(queue.next(now)), (Bulk, vec![2, 4, 6]));
        assert_eq!(queue.next(now), Next::Nothing);
    }

    #[test]
    fn bulk_tasks_wait_for_senders_but_not_for_ever() {
        let (mut queue, now) = (WriteQueue::default(), Instant::now());
        queue.add_sender();
        queue.add_sender();
        queue.push(Bulk, 0, now);
        assert_eq!(queue.next(now), Next::HeldBack(now + LONGEST_BEHIND));
        queue.push(Prompt, 1, now);
        assert_eq!(taken(queue.next(now)), (Prompt, vec![1]));
        assert!(!queue.remove_sender(), "another sender waits");
        assert_eq!(queue.next(now), Next::HeldBack(now + LONGEST_BEHIND));
        assert_eq!(taken(queue.next(now + LONGEST_BEHIND)), (Bulk, vec![0]));
        queue.push(Bulk, 2, now);
        assert!(queue.remove_sender());
        assert_eq!(taken(queue.next(now)), (Bulk, vec![2]));
    }

    #[test]
    fn neither_kind_keeps_the_other_from_running() {
        let (mut queue, start) = (WriteQueue::default(), Instant::now());
        (0..4).for_each(|task| queue.push(Bulk, task, start));
        let (mut now, mut order) = (start, Vec::new());
        while order.len() < 400 {
            queue.push(Prompt, 9, now);
            let Next::Group(priority, mut group) = queue.next(now) else { panic!("a task waits") };
            order.push(group.pop_front().unwrap().1);
            if priority == Bulk {
                assert!(now >= start + LONGEST_BEHIND);
                queue.put_back(group);
            }
            now += Duration::from_millis(7);
        }
        // From the time on at which the bulk tasks are due, the two take turns.
        let first = order.iter().position(|task| *task == 0).unwrap();
        assert_eq!(order[first..first + 8], [0, 9, 1, 9, 2, 9, 3, 9]);
    }

    #[test]
    fn a_group_has_a_limit() {
        let (mut queue, now) = (WriteQueue::default(), Instant::now());
        (0..=GROUP_LIMIT).for_each(|task| queue.push(Prompt, task, now));
        assert_eq!(taken(queue.next(now)).1.len(), GROUP_LIMIT);
        assert_eq!(taken(queue.next(now)), (Prompt, vec![GROUP_LIMIT]));
    }
}
