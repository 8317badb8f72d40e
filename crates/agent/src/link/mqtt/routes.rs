//! Routes of an MQTT session to the server: the broker's own port, or a WebSocket over the HTTP
//! port, which is open wherever a robot can reach its server at all. When one route fails, the
//! other is tried. This module opens no connection.

use std::sync::Arc;

use reqwest::Url;
use rustls::ClientConfig;
use task_proto::api::ExternalBroker;
use task_transport::{Route, Trust};

use crate::config::MqttTransport;
use crate::system::clock;

/// The available routes, and the next one to try.
#[derive(Clone)]
pub struct Routes {
    transport: MqttTransport,
    /// TLS configuration for either port.
    tls: Arc<ClientConfig>,
    /// WebSocket route to the server.
    websocket: Route,
    /// Whether to skip the broker's own port.
    is_switched: bool,
}

impl Routes {
    /// Routes to the server at `base`.
    pub fn new(base: &Url, tls: Arc<ClientConfig>, transport: MqttTransport) -> Self {
        let websocket = Route {
            host: base.host_str().map(str::to_owned).unwrap_or_default(),
            port: base.port_or_known_default().unwrap_or_default(),
            tls: (base.scheme() == "https").then(|| tls.clone()),
            websocket: Some(format!("{}/mqtt", base.path().trim_end_matches('/'))),
        };
        Self { transport, tls, websocket, is_switched: false }
    }

    /// The next route. An external broker offers only its own port, with a certificate from another
    /// issuer.
    pub(super) fn next(
        &self,
        host: &str,
        port: u16,
        is_encrypted: bool,
        external: Option<&ExternalBroker>,
    ) -> Route {
        let by_websocket = match self.transport {
            MqttTransport::Auto => self.is_switched,
            MqttTransport::Tcp => false,
            MqttTransport::Websocket => true,
        };
        let tls = match external {
            None if by_websocket => return self.websocket.clone(),
            _ if !is_encrypted => None,
            None => Some(self.tls.clone()),
            Some(broker) => {
                Some(Arc::new(Trust::by(broker.ca_pin).client_config(clock::for_certificates())))
            }
        };
        Route { host: host.to_owned(), port, tls, websocket: None }
    }

    /// Switches to the other route after a failed attempt.
    pub(super) fn switch(&mut self) {
        self.is_switched = !self.is_switched;
    }

    /// Returns to the broker's own port, because the server named another place that may be
    /// reachable.
    pub(super) fn reset(&mut self) {
        self.is_switched = false;
    }
}

#[cfg(test)]
mod tests {
    use task_transport::Clock;

    use super::*;

    fn routes(base: &str, transport: MqttTransport) -> Routes {
        let tls = Trust::System.client_config(Clock::new(|| 0));
        Routes::new(&base.parse().expect("a URL"), Arc::new(tls), transport)
    }

    /// Host, port, WebSocket path, and whether the route is encrypted.
    fn shown(route: Route) -> (String, u16, Option<String>, bool) {
        (route.host, route.port, route.websocket, route.tls.is_some())
    }

    #[test]
    fn failed_route_switches_to_the_other() {
        let mut routes = routes("https://fleet.lab/tasks/", MqttTransport::Auto);
        let direct = |routes: &Routes| shown(routes.next("fleet.lab", 8883, true, None));
        let own_port = ("fleet.lab".to_owned(), 8883, None, true);
        let websocket = ("fleet.lab".to_owned(), 443, Some("/tasks/mqtt".to_owned()), true);
        assert_eq!(direct(&routes), own_port);
        routes.switch();
        assert_eq!(direct(&routes), websocket);
        let broker =
            ExternalBroker { password: "secret".to_owned(), client_id: None, ca_pin: None };
        assert_eq!(
            shown(routes.next("broker.lab", 1883, false, Some(&broker))),
            ("broker.lab".to_owned(), 1883, None, false),
            "an external broker has no such way"
        );
        let encrypted = ("broker.lab".to_owned(), 8883, None, true);
        assert_eq!(shown(routes.next("broker.lab", 8883, true, Some(&broker))), encrypted);
        routes.switch();
        assert_eq!(direct(&routes), own_port);
        routes.switch();
        routes.reset();
        assert_eq!(direct(&routes), own_port);
        assert_eq!(
            shown(routes.next("fleet.lab", 1883, false, None)),
            ("fleet.lab".to_owned(), 1883, None, false)
        );
    }

    #[test]
    fn configured_transport_never_switches() {
        let mut tcp = routes("http://10.0.0.7:8080", MqttTransport::Tcp);
        tcp.switch();
        assert_eq!(
            shown(tcp.next("10.0.0.7", 1883, false, None)),
            ("10.0.0.7".to_owned(), 1883, None, false)
        );
        let websocket = routes("http://10.0.0.7:8080", MqttTransport::Websocket);
        let way = ("10.0.0.7".to_owned(), 8080, Some("/mqtt".to_owned()), false);
        assert_eq!(shown(websocket.next("10.0.0.7", 1883, false, None)), way);
    }
}
