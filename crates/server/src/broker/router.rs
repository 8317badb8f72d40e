//! The rumqttd router.
