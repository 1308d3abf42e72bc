//! Amazon's registries, played on loopback: one server that hands out passwords as ECR does, and a registry that asks for the present one.

use std::sync::{Arc, Mutex};

use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use serde_json::json;
use tokio::net::TcpListener;
use tokio::task::JoinSet;

use super::super::tests::images::{ImageRegistry, config};
use super::super::{Clients, Facts, Fault, Image, Registries};
use super::*;

/// What ECR is asked, and what it answers.
struct Account {
    /// Status and body.
    answer: (StatusCode, String),
    asked: Vec<(String, String)>,
}

/// An account whose registry is on loopback.
struct Amazon {
    registry: ImageRegistry,
    account: Arc<Mutex<Account>>,
    registries: Registries,
    _task: JoinSet<()>,
}

/// What is on loopback is Amazon's here.
fn here(registry: &str) -> Option<AmazonRegistry<'_>> {
    let place = AmazonRegistry {
        region: "eu-west-1",
        domain: "amazonaws.com",
    };
    registry.starts_with("127.0.0.1:").then_some(place)
}

/// `AWS:<password>` in base64, as ECR gives it and as `Basic` wants it.
fn token(password: &str) -> String {
    Credentials::new("AWS", password)
        .unwrap()
        .header()
        .split_off("Basic ".len())
}

/// ECR's answer with this password, which ends so many seconds from now.
fn given(password: &str, seconds: u64) -> (StatusCode, String) {
    let ends = SystemTime::now() + Duration::from_secs(seconds);
    let ends = ends.duration_since(UNIX_EPOCH).unwrap().as_secs_f64();
    let data = json!({"authorizationToken": token(password), "expiresAt": ends, "proxyEndpoint": "https://r.example"});
    (StatusCode::OK, json!({"authorizationData": [data]}).to_string())
}

async fn answer(State(account): State<Arc<Mutex<Account>>>, request: Request) -> Response {
    let header = |name: &str| {
        request
            .headers()
            .get(name)
            .map(|value| value.to_str().unwrap().to_owned())
    };
    let asked = (header("x-amz-target").unwrap(), header("authorization").unwrap());
    let mut account = account.lock().unwrap();
    account.asked.push(asked);
    account.answer.clone().into_response()
}

impl Amazon {
    /// ECR gives this, and the registry takes that password.
    async fn start(first: (StatusCode, String), taken: &str) -> Self {
        let account = Account {
            answer: first,
            asked: Vec::new(),
        };
        let account = Arc::new(Mutex::new(account));
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let router = axum::Router::new().fallback(answer).with_state(Arc::clone(&account));
        let mut task = JoinSet::new();
        task.spawn(async move { axum::serve(listener, router).await.unwrap() });
        let aws = crate::controller::fixtures::aws(&endpoint).await;
        let mut registries = Registries::new(&aws);
        let mut clients = Clients::new(&aws).unwrap();
        clients.ecr.place = here;
        registries.clients = Ok(clients).into();
        let registry = ImageRegistry::start().await;
        registry.push("one", &config(), 1);
        let amazon = Self {
            registry,
            account,
            registries,
            _task: task,
        };
        amazon.takes(taken);
        amazon
    }

    fn takes(&self, password: &str) {
        let challenge = "Basic realm=\"https://r.example/\",service=\"ecr.amazonaws.com\"";
        self.registry.guard(challenge, &format!("Basic {}", token(password)));
    }

    fn gives(&self, answer: (StatusCode, String)) {
        self.account.lock().unwrap().answer = answer;
    }

    fn asked(&self) -> usize {
        self.account.lock().unwrap().asked.len()
    }

    async fn look_up(&self, tag: &str) -> Result<Facts, Fault> {
        let image = Image {
            registry: self.registry.host(),
            path: "team".into(),
            reference: tag.into(),
            may_be_local: true,
        };
        self.registries.look_up(&image, None).await
    }

    /// The password has been known for so long.
    fn age(&self, age: Duration) {
        let clients = self.registries.clients.get().unwrap().as_ref().unwrap();
        let mut kept = clients.ecr.kept();
        kept.values_mut().for_each(|kept| kept.since -= age);
    }
}

#[tokio::test]
async fn an_image_is_looked_up_with_the_password_that_ecr_gives_for_its_region() {
    let amazon = Amazon::start(given("first", 43_200), "first").await;
    for _ in 0..2 {
        assert!(amazon.look_up("one").await.unwrap().digest.starts_with("sha256:"));
    }
    assert_eq!(amazon.look_up("none").await, Err(Fault::NotFound));
    let asked = amazon.account.lock().unwrap().asked.clone();
    let [(target, authorization)] = asked.as_slice() else {
        panic!("once: {asked:?}")
    };
    assert_eq!(target, TARGET);
    assert!(
        authorization.starts_with("AWS4-HMAC-SHA256 Credential=test/"),
        "{authorization}"
    );
    assert!(authorization.contains("/eu-west-1/ecr/aws4_request"), "{authorization}");
    let seen = amazon.registry.seen();
    let basic = format!("Basic {}", token("first"));
    assert!(seen.iter().all(|(_, given)| given.as_ref() == Some(&basic)), "{seen:?}");
}

#[tokio::test]
async fn a_password_that_is_about_to_end_is_not_used_again() {
    let amazon = Amazon::start(given("first", 200), "first").await;
    amazon.look_up("one").await.unwrap();
    amazon.gives(given("second", 43_200));
    amazon.takes("second");
    amazon.look_up("one").await.unwrap();
    assert_eq!(amazon.asked(), 2);
}

#[tokio::test]
async fn a_password_that_has_ended_early_is_fetched_anew_once() {
    let amazon = Amazon::start(given("first", 43_200), "first").await;
    amazon.look_up("one").await.unwrap();
    amazon.gives(given("second", 43_200));
    amazon.takes("second");
    amazon.age(FRESH);
    amazon.look_up("one").await.unwrap();
    assert_eq!(amazon.asked(), 2);
    // What refuses a new one would refuse each: no more than one is fetched for an image.
    amazon.takes("nobody's");
    amazon.age(FRESH);
    assert_eq!(amazon.look_up("one").await, Err(Fault::Denied));
    assert_eq!(amazon.asked(), 3);
    assert_eq!(amazon.look_up("one").await, Err(Fault::Denied));
    assert_eq!(amazon.asked(), 3, "it is fresh");
}

#[tokio::test]
async fn without_the_right_to_a_password_a_host_reads_which_rights_are_missing() {
    let denied = json!({"__type": "AccessDeniedException", "message": "User secret-name is not authorized"});
    let amazon = Amazon::start((StatusCode::BAD_REQUEST, denied.to_string()), "first").await;
    let Err(Fault::Unreachable(why)) = amazon.look_up("one").await else {
        panic!("without a password nothing is known");
    };
    assert!(
        why.contains("give the operator ecr:GetAuthorizationToken, ecr:BatchGetImage"),
        "{why}"
    );
    assert!(!why.contains("secret-name"), "{why}");
    assert_eq!(amazon.registry.seen(), []);
}

#[tokio::test]
async fn an_odd_answer_of_ecr_is_no_password_and_its_length_is_bounded() {
    for body in ["{}".to_owned(), "[".to_owned(), " ".repeat(LARGEST + 1)] {
        let amazon = Amazon::start((StatusCode::OK, body), "first").await;
        assert!(matches!(amazon.look_up("one").await, Err(Fault::Unreachable(_))));
    }
}
