//! The order in which write tasks run.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Largest number of tasks in one group commit. The first of them is answered only after the last has run.
pub(super) const GROUP_LIMIT: usize = 64;

/// The longest time for which tasks of bulk work wait for others. The others need the connection all the time if it comes to that.
const LONGEST_BEHIND: Duration = Duration::from_secs(1);

/// Which write tasks run first. Tasks of the same priority run in the order in which they were queued.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WritePriority {
    /// What somebody waits for.
    Prompt,
    /// Bulk work: it runs while nothing else waits, but no later than about a second after it was queued.
    Bulk,
}

/// Tasks that run in one transaction, each with the time at which it was queued.
pub(super) type Group<T> = VecDeque<(Instant, T)>;

/// The tasks that wait.
pub(super) struct WriteQueue<T> {
    prompt: Group<T>,
    bulk: Group<T>,
}

impl<T> Default for WriteQueue<T> {
    fn default() -> Self {
        Self { prompt: VecDeque::new(), bulk: VecDeque::new() }
    }
}

impl<T> WriteQueue<T> {
    pub(super) fn push(&mut self, priority: WritePriority, task: T, now: Instant) {
        match priority {
            WritePriority::Prompt => self.prompt.push_back((now, task)),
            WritePriority::Bulk => self.bulk.push_back((now, task)),
        }
    }

    /// Whether a prompt task waits.
    pub(super) fn has_prompt(&self) -> bool {
        !self.prompt.is_empty()
    }

    /// Takes the tasks of the next group commit, which have the same priority; `None` if nothing waits.
    pub(super) fn next_group(&mut self, now: Instant) -> Option<(WritePriority, Group<T>)> {
        let is_due = |since: Instant| now.saturating_duration_since(since) >= LONGEST_BEHIND;
        let bulk_is_due = self.bulk.front().is_some_and(|(since, _)| is_due(*since));
        let (priority, queue) = if self.prompt.is_empty() || bulk_is_due {
            (WritePriority::Bulk, &mut self.bulk)
        } else {
            (WritePriority::Prompt, &mut self.prompt)
        };
        let count = queue.len().min(GROUP_LIMIT);
        (count > 0).then(|| (priority, queue.drain(..count).collect()))
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

    fn taken(group: Option<(WritePriority, Group<usize>)>) -> (WritePriority, Vec<usize>) {
        let (priority, group) = group.unwrap();
        (priority, group.into_iter().map(|(_, task)| task).collect())
    }

    #[test]
    fn prompt_tasks_run_first_and_each_kind_in_its_order() {
        let (mut queue, now) = (WriteQueue::default(), Instant::now());
        for (task, priority) in [Bulk, Prompt, Bulk, Prompt, Bulk].into_iter().enumerate() {
            queue.push(priority, task, now);
        }
        assert_eq!(taken(queue.next_group(now)), (Prompt, vec![1, 3]));
        let (_, mut group) = queue.next_group(now).unwrap();
        assert_eq!(group.pop_front().map(|(_, task)| task), Some(0));
        // A prompt task arrives, and the others are held back; further ones are queued behind them.
        queue.push(Prompt, 5, now);
        queue.push(Bulk, 6, now);
        assert!(queue.has_prompt());
        queue.put_back(group);
        assert_eq!(taken(queue.next_group(now)), (Prompt, vec![5]));
        assert!(!queue.has_prompt());
        assert_eq!(taken(queue.next_group(now)), (Bulk, vec![2, 4, 6]));
        assert!(queue.next_group(now).is_none());
    }

    #[test]
    fn a_bulk_task_runs_in_time_although_prompt_ones_never_end() {
        let (mut queue, start) = (WriteQueue::default(), Instant::now());
        queue.push(Bulk, 0, start);
        let mut now = start;
        let waited = loop {
            queue.push(Prompt, 1, now);
            let (priority, tasks) = taken(queue.next_group(now));
            if priority == Bulk {
                assert_eq!(tasks, [0]);
                break now - start;
            }
            now += Duration::from_millis(7);
            assert!(now - start < 2 * LONGEST_BEHIND);
        };
        assert!(waited >= LONGEST_BEHIND, "it ran after {waited:?}");
        assert_eq!(taken(queue.next_group(now)), (Prompt, vec![1]), "then the others go on");
    }

    #[test]
    fn a_group_has_a_limit() {
        let (mut queue, now) = (WriteQueue::default(), Instant::now());
        (0..=GROUP_LIMIT).for_each(|task| queue.push(Prompt, task, now));
        assert_eq!(taken(queue.next_group(now)).1.len(), GROUP_LIMIT);
        assert_eq!(taken(queue.next_group(now)), (Prompt, vec![GROUP_LIMIT]));
    }
}
