//! The Leaderboard that all submissions are for, with its token.

use super::*;

pub(super) async fn make_board(
    client: &Client,
    namespace: &str,
    size: &Size,
    evalai: &Handle,
    bucket: &str,
    endpoint: &str,
) {
    let secret: Api<k8s_openapi::api::core::v1::Secret> = Api::namespaced(client.clone(), namespace);
    let token = json!({"apiVersion": "v1", "kind": "Secret", "metadata": {"name": "evalai"}, "stringData": {"token": "local-host-token"}});
    let token = serde_json::from_value(token).unwrap();
    secret.create(&kube::api::PostParams::default(), &token).await.unwrap();
    let spec: Value = json!({"spec": {
        "evalai": {
            "apiServer": evalai.url(), "challenge": 1, "requestsPerMinute": size.requests_per_minute,
            "token": {"secretKeyRef": {"name": "evalai", "key": "token"}},
        },
        "tracks": [{"name": "sensors", "phase": 1}],
        "agent": {"images": []},
        "storage": {"s3": {"bucket": bucket, "endpoint": endpoint}},
        "syncPeriodSeconds": size.period_seconds,
        "evaluation": {"carla": {"pairs": 1, "routes": ROUTES}},
    }});
    let api = Kind::Leaderboard.api(client, namespace);
    create(&api, Kind::Leaderboard.object(BOARD, &[&spec]), false)
        .await
        .unwrap();
    let boards: Api<Leaderboard> = Api::namespaced(client.clone(), namespace);
    assert!(boards.get(BOARD).await.is_ok());
}
