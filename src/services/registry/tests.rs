//! Look-ups at a registry on loopback, honest and hostile.

use serde_json::{Value, json};

use super::*;
use images::{ImageRegistry, config, digest};

#[path = "../../../tests/support/images.rs"]
pub(super) mod images;

/// Nobody listens at the endpoint: no test here needs AWS.
async fn registries() -> Registries {
    Registries::new(&crate::controller::fixtures::aws("http://127.0.0.1:9").await)
}

fn image(registry: &ImageRegistry, reference: &str) -> Image {
    Image {
        registry: registry.host(),
        path: "team".into(),
        reference: reference.into(),
        may_be_local: true,
    }
}

async fn look_up(registry: &ImageRegistry, reference: &str) -> Result<Facts, Fault> {
    registries().await.look_up(&image(registry, reference), None).await
}

fn unreachable_for(answer: Result<Facts, Fault>, words: &str) {
    match answer {
        Err(Fault::Unreachable(why) | Fault::Unusable(why)) => assert!(why.contains(words), "{why}"),
        other => panic!("{other:?}"),
    }
}

#[tokio::test]
async fn a_tag_gives_digest_size_platform_and_volumes() {
    let registry = ImageRegistry::start().await;
    let plain = registry.push("plain", &config(), 1000);
    let found = look_up(&registry, "plain").await.unwrap();
    let size = u64::try_from(config().to_string().len()).unwrap();
    assert_eq!((found.digest.as_str(), found.bytes), (plain.as_str(), 1000 + size));
    assert!(!found.has_volumes);
    let mut with_volumes = config();
    with_volumes["config"] = json!({"Volumes": {"/data": {}}});
    registry.push("volumes", &with_volumes, 1);
    assert!(look_up(&registry, "volumes").await.unwrap().has_volumes);
    let mut other = config();
    other["architecture"] = json!("arm64");
    registry.push("arm", &other, 1);
    assert_eq!(look_up(&registry, "arm").await, Err(Fault::OtherPlatform));
    assert_eq!(look_up(&registry, "none").await, Err(Fault::NotFound));
}

#[tokio::test]
async fn an_index_gives_the_manifest_of_our_machines() {
    let registry = ImageRegistry::start().await;
    let mut ours = registry.store("manifests", &registry.manifest(&config(), 7));
    ours["platform"] = json!({"os": "linux", "architecture": "amd64"});
    let mut arm = registry.store("manifests", &registry.manifest(&config(), 8));
    arm["platform"] = json!({"os": "linux", "architecture": "arm64"});
    let push = |tag: &str, images: Value| {
        let index = json!({"schemaVersion": 2, "manifests": images});
        registry.put(&format!("manifests/{tag}"), index.to_string().into_bytes())
    };
    let named = push("both", json!([arm, ours]));
    assert_eq!(
        look_up(&registry, "both").await.unwrap().digest,
        ours["digest"].as_str().unwrap()
    );
    registry.store("manifests", &json!({"schemaVersion": 2, "manifests": [arm, ours]}));
    let by_digest = look_up(&registry, &named).await.unwrap();
    assert_eq!(by_digest.digest, ours["digest"].as_str().unwrap());
    push("arm", json!([arm]));
    assert_eq!(look_up(&registry, "arm").await, Err(Fault::OtherPlatform));
    let mut nested = registry.store("manifests", &json!({"schemaVersion": 2, "manifests": [ours]}));
    nested["platform"] = ours["platform"].clone();
    push("nested", json!([nested]));
    assert!(matches!(look_up(&registry, "nested").await, Err(Fault::NotAnImage(_))));
    let mut gone = ours.clone();
    gone["digest"] = json!(digest(b"gone"));
    push("gone", json!([gone]));
    assert!(matches!(look_up(&registry, "gone").await, Err(Fault::NotAnImage(_))));
}

#[tokio::test]
async fn an_answer_that_does_not_match_its_digest_is_refused() {
    let registry = ImageRegistry::start().await;
    let wanted = digest(b"something else");
    registry.put(
        &format!("manifests/{wanted}"),
        registry.manifest(&config(), 1).to_string().into_bytes(),
    );
    unreachable_for(look_up(&registry, &wanted).await, "digest");
    let manifest = registry.manifest(&config(), 1);
    let of_config = manifest["config"]["digest"].as_str().unwrap().to_owned();
    registry.put("manifests/forged", manifest.to_string().into_bytes());
    registry.put(&format!("blobs/{of_config}"), b"{\"config\": {}}".to_vec());
    unreachable_for(look_up(&registry, "forged").await, "digest");
}

#[tokio::test]
async fn what_is_too_large_to_be_a_manifest_or_a_config_is_not_read() {
    let registry = ImageRegistry::start().await;
    registry.put("manifests/large", vec![b' '; LARGEST + 1]);
    assert_eq!(look_up(&registry, "large").await, Err(too_large()));
    let mut manifest = registry.manifest(&config(), 1);
    manifest["config"]["size"] = json!(LARGEST + 1);
    registry.put("manifests/config", manifest.to_string().into_bytes());
    assert_eq!(look_up(&registry, "config").await, Err(too_large()));
    let asked = registry
        .seen()
        .iter()
        .filter(|(path, _)| path.contains("blobs"))
        .count();
    assert_eq!(asked, 0, "its size is known before");
}

#[tokio::test]
async fn no_redirect_leads_into_a_private_network() {
    let other = ImageRegistry::start().await;
    for target in [
        format!("http://{}/v2/team/manifests/x", other.host()),
        format!("https://{}/v2/team/manifests/x", other.host()),
        "http://169.254.169.254/latest/meta-data/".into(),
        "https://169.254.169.254/latest/meta-data/".into(),
        "https://10.0.0.5:8080/".into(),
        "https://[::ffff:10.0.0.5]/".into(),
        "https://0x7f.1/".into(),
        "https://localhost/".into(),
        "https://user:password@52.216.1.1/".into(),
        "file:///etc/passwd".into(),
    ] {
        let registry = ImageRegistry::start().await;
        registry.redirect("manifests/moved", &target);
        let answer = look_up(&registry, "moved").await;
        let is_refused = matches!(answer, Err(Fault::Unreachable(_) | Fault::Unusable(_)));
        assert!(is_refused, "{target}: {answer:?}");
    }
    assert_eq!(other.seen(), []);
}

#[tokio::test]
async fn a_registry_whose_name_leads_to_this_machine_is_not_asked() {
    let other = ImageRegistry::start().await;
    let local = other.host().replace("127.0.0.1", "localhost");
    assert!(local.starts_with("localhost:"), "{local}");
    let image = Image {
        registry: local,
        may_be_local: false,
        ..image(&other, "one")
    };
    // Where the name leads is not said to those who may choose it.
    let why = "its address is one that no look-up may go to".to_owned();
    assert_eq!(
        registries().await.look_up(&image, None).await,
        Err(Fault::Unreachable(why))
    );
    assert_eq!(other.seen(), []);
}

#[tokio::test]
async fn a_redirect_within_the_registry_is_followed_a_few_times() {
    let registry = ImageRegistry::start().await;
    let manifest = registry.push("here", &config(), 1);
    registry.redirect("manifests/there", "/v2/team/manifests/here");
    assert_eq!(look_up(&registry, "there").await.unwrap().digest, manifest);
    registry.redirect("manifests/round", "round");
    unreachable_for(look_up(&registry, "round").await, "redirects too often");
}

#[tokio::test]
async fn credentials_are_given_as_the_registry_asks_and_to_nobody_else() {
    let credentials = || Credentials::new("user", "secret");
    let registry = ImageRegistry::start().await;
    registry.push("one", &config(), 1);
    registry.guard("Basic realm=\"x\"", "Basic dXNlcjpzZWNyZXQ=");
    let registries = registries().await;
    let image_of = |registry: &ImageRegistry| image(registry, "one");
    assert!(registries.look_up(&image_of(&registry), credentials()).await.is_ok());
    let wrong = Credentials::new("user", "wrong");
    assert_eq!(
        registries.look_up(&image_of(&registry), wrong).await,
        Err(Fault::Denied)
    );

    let registry = ImageRegistry::start().await;
    registry.push("one", &config(), 1);
    let challenge = format!("Bearer realm=\"http://{}/token\",service=\"s\"", registry.host());
    registry.guard(&challenge, "Bearer one-token");
    assert!(registries.look_up(&image_of(&registry), credentials()).await.is_ok());
    let asked = registry.seen();
    let (path, given) = asked.iter().find(|(path, _)| path.starts_with("/token")).unwrap();
    assert_eq!(path, "/token?service=s&scope=repository%3Ateam%3Apull");
    assert_eq!(given.as_deref(), Some("Basic dXNlcjpzZWNyZXQ="));

    let (registry, thief) = (ImageRegistry::start().await, ImageRegistry::start().await);
    registry.guard(
        &format!("Bearer realm=\"http://{}/token\"", thief.host()),
        "Bearer one-token",
    );
    unreachable_for(
        registries.look_up(&image_of(&registry), credentials()).await,
        "no look-up may go to",
    );
    assert_eq!(thief.seen(), []);
}

#[tokio::test]
async fn without_credentials_a_refusal_shows_nothing_of_what_nodes_may_pull() {
    let registry = ImageRegistry::start().await;
    registry.guard("Basic realm=\"x\"", "Basic dXNlcjpzZWNyZXQ=");
    unreachable_for(look_up(&registry, "one").await, "credentials");
    for status in [429, 500, 503] {
        let registry = ImageRegistry::start().await;
        registry.fail("manifests/one", status);
        unreachable_for(look_up(&registry, "one").await, &status.to_string());
    }
}

#[tokio::test]
async fn a_registry_that_does_not_answer_is_left_alone_for_a_while_and_no_other_answer_has_that_effect() {
    let registry = ImageRegistry::start().await;
    registry.fail("manifests/one", 503);
    let registries = registries().await;
    for _ in 0..3 {
        unreachable_for(registries.look_up(&image(&registry, "one"), None).await, "503");
    }
    assert_eq!(registry.seen().len(), 1);
    // Else one team could keep the others' images unchecked.
    let registry = ImageRegistry::start().await;
    registry.fail("manifests/odd", 400);
    registry.push("one", &config(), 1);
    unreachable_for(registries.look_up(&image(&registry, "odd"), None).await, "400");
    assert!(registries.look_up(&image(&registry, "one"), None).await.is_ok());
}

#[tokio::test]
async fn a_registry_of_this_machine_is_asked_only_where_the_host_has_named_it() {
    let registry = ImageRegistry::start().await;
    registry.push("one", &config(), 1);
    let image = Image {
        may_be_local: false,
        ..image(&registry, "one")
    };
    unreachable_for(registries().await.look_up(&image, None).await, "no look-up may go to");
    let metadata = Image {
        registry: "169.254.169.254".into(),
        may_be_local: true,
        ..image
    };
    unreachable_for(
        registries().await.look_up(&metadata, None).await,
        "no look-up may go to",
    );
    assert_eq!(registry.seen(), []);
}
