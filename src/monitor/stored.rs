//! The records and errors of the store that the application returns to its callers.

pub use crate::store::{
    backup, schema_version, Acknowledgement, AuditEntry, AuditQuery, BatchRecord, ChartMark, ChartSeries, Delivery,
    DeliveryState, DiagnosisRecord, DiagnosisTrigger, Episode, EpisodeDiagnosis, EpisodeQuery, Error, EventFilter,
    Exceedance, HistoryEntry, HistoryQuery, JobKind, JobRecord, JobState, LatestAssessment, LatestPoint,
    LatestQuantity, MaintenanceWindow, MeasurementPlace, MeasurementQuery, NewAuditEntry, OpenAlarms, PutStructure,
    QuantityMark, QuantitySeries, QuarantinedMessage, ReferenceRecord, ReferenceVersion, RelativeChange, SeriesWindow,
    StoredChartPoint, StoredMeasurement, StructureOverview, TrustMark, WebhookRecord,
};
