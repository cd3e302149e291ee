//! The topic of batches.

/// Placeholder for the structure id.
pub const PLACEHOLDER: &str = "{structure}";

/// The topic of batches.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topic {
    levels: Vec<String>,
}

impl Topic {
    /// A topic with one level `{structure}` and no wildcards; `None` for any other text.
    pub fn new(template: &str) -> Option<Self> {
        let levels: Vec<String> = template.split('/').map(str::to_owned).collect();
        let once = levels.iter().filter(|level| *level == PLACEHOLDER).count() == 1;
        let plain = |level: &String| level == PLACEHOLDER || !level.contains(['+', '#', '{', '}', '\0']);
        let valid = once && levels.iter().all(plain) && template.len() <= 500 && !template.starts_with('$');
        valid.then_some(Self { levels })
    }

    /// Topic filter of the subscription.
    pub fn filter(&self) -> String {
        let level = |level: &String| if level == PLACEHOLDER { "+".to_owned() } else { level.clone() };
        self.levels.iter().map(level).collect::<Vec<_>>().join("/")
    }

    /// The structure id in a topic; `None` if the topic has another form.
    pub fn structure<'t>(&self, topic: &'t str) -> Option<&'t str> {
        let found: Vec<&str> = topic.split('/').collect();
        let same = |(own, found): (&String, &&str)| own == PLACEHOLDER || own == *found;
        if found.len() != self.levels.len() || !self.levels.iter().zip(&found).all(same) {
            return None;
        }
        self.levels.iter().zip(found).find(|(own, _)| *own == PLACEHOLDER).map(|(_, found)| found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_topic_names_its_structure() {
        let topic = Topic::new("site/{structure}/batches").unwrap();
        assert_eq!(topic.filter(), "site/+/batches");
        assert_eq!(topic.structure("site/bridge-7/batches"), Some("bridge-7"));
        for other in ["site/batches", "site/a/b/batches", "other/a/batches", "site/a/batches/"] {
            assert_eq!(topic.structure(other), None, "{other}");
        }
        for wrong in ["batches", "a/{structure}/{structure}", "a/+/{structure}", "{structure}/#", "a/x{structure}", ""]
        {
            assert!(Topic::new(wrong).is_none(), "{wrong}");
        }
    }
}
