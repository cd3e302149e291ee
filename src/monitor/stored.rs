//! The records and errors of the store that the application returns to its callers.

pub use crate::store::{
    backup, Acknowledgement, ActionKind, ActionOutcome, AlarmAction, AuditEntry, AuditQuery, BatchHeader, BatchRecord,
    ChartMark, ChartSeries, ClosingReason, Delivery, DeliveryState, DiagnosisRecord, DiagnosisTrigger, Engine, Episode,
    EpisodeDiagnosis, EpisodeQuery, Error, EventFilter, Exceedance, Handling, HistoryEntry, HistoryQuery, JobKind,
    JobRecord, JobState, LatestAssessment, LatestPoint, LatestQuantity, MaintenanceWindow, MeasurementPlace,
    MeasurementQuery, NewAction, NewAuditEntry, Note, OpenAlarms, PutStructure, QuantityMark, QuantitySeries,
    QuarantinedMessage, ReferenceRecord, ReferenceVersion, RelativeChange, SeriesWindow, StoredChartPoint,
    StoredMeasurement, StructureOverview, TrainingJobRecord, TrustMark, WebhookRecord, MOST_ACTIONS, MOST_NOTES,
};
