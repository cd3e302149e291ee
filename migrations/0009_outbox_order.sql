-- Messages wait for the older ones of their own alarm only, and are looked up by the time of their next attempt.

create index outbox_event_of_alarm on outbox_event (structure_id, episode, event_id);

create index webhook_delivery_by_time on webhook_delivery (webhook_id, next_at_us) where state = 'pending';
