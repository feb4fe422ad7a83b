//! What is counted of each tenant. Tenants are in the configuration, in files of tokens, or names of folders: nobody who
//! calls makes a new one, so the number of time series is bounded.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric as _};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;

use crate::core::room::Room;
use crate::core::tenant::{Account, Rooms, Tenant, Tenants};

/// All tenants, or one.
#[derive(Debug)]
pub(super) struct TenantCounters {
    pub(super) tenants: Arc<Tenants>,
    /// The only one that is shown.
    pub(super) only: Option<Tenant>,
}

impl TenantCounters {
    fn accounts(&self) -> Vec<Arc<Account>> {
        let mut accounts = self.tenants.accounts();
        accounts.retain(|account| self.only.is_none_or(|only| account.tenant == only));
        accounts
    }
}

/// What of a tenant's room is shown.
type Of = fn(&Rooms) -> &Arc<Room>;

impl Collector for TenantCounters {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let accounts = self.accounts();
        let rooms: [(&str, &str, Of); 3] = [
            ("tenant_plants", "Plants of a tenant", |rooms| &rooms.plants),
            ("tenant_running_plants", "Those that run by themselves", |rooms| {
                &rooms.running_plants
            }),
            ("tenant_streams", "Open streams and calls of a tenant", |rooms| &rooms.streams),
        ];
        for (name, help, of) in rooms {
            let mut metric = encoder.encode_descriptor(name, help, None, MetricType::Gauge)?;
            for account in &accounts {
                let used = i64::try_from(of(&account.rooms).used()).unwrap_or(i64::MAX);
                let label = [("tenant", account.name.as_str())];
                ConstGauge::new(used).encode(metric.encode_family(&label)?)?;
            }
        }
        let help = "Steps of a tenant's plants that ended after the next was due";
        let kind = MetricType::Counter;
        let mut metric = encoder.encode_descriptor("tenant_overruns", help, None, kind)?;
        for account in &accounts {
            let count = account.counts.overruns.load(Ordering::Relaxed);
            let label = [("tenant", account.name.as_str())];
            ConstCounter::new(count).encode(metric.encode_family(&label)?)?;
        }
        let help = "Calls of a tenant that ended";
        let mut metric = encoder.encode_descriptor("tenant_rpcs", help, None, kind)?;
        for account in &accounts {
            for (code, count) in account.counts.calls() {
                let labels = [("tenant", account.name.as_str()), ("code", code)];
                ConstCounter::new(count).encode(metric.encode_family(&labels)?)?;
            }
        }
        Ok(())
    }
}
