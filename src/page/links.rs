//! Addresses of EvalAI's website. Pure.
//!
//! EvalAI has no page of one submission: its hosts find it in the list of all submissions of the challenge.

use leaderboard_api::Evalai;

/// The challenge's page.
pub(super) fn challenge(evalai: &Evalai) -> Option<String> {
    page(evalai, "overview")
}

/// The list of all submissions, which only the challenge's hosts can open.
pub(super) fn submissions(evalai: &Evalai) -> Option<String> {
    page(evalai, "my-challenge-all-submission")
}

/// None for a server without TLS: that is one inside the cluster, where no browser comes.
fn page(evalai: &Evalai, of: &str) -> Option<String> {
    let server = evalai.server();
    let is_public = server.starts_with("https://");
    is_public.then(|| format!("{server}/web/challenges/challenge-page/{}/{of}", evalai.challenge))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_that_a_browser_reaches_has_links() {
        let evalai = |server: &str| -> Evalai {
            let spec = serde_json::json!({
                "apiServer": server, "challenge": 42, "token": {"secretKeyRef": {"name": "token", "key": "token"}},
            });
            serde_json::from_value(spec).unwrap()
        };
        let public = evalai("https://Eval.AI/");
        let page = "https://eval.ai/web/challenges/challenge-page/42";
        assert_eq!(challenge(&public), Some(format!("{page}/overview")));
        assert_eq!(
            submissions(&public),
            Some(format!("{page}/my-challenge-all-submission"))
        );
        for server in ["http://evalai.demo.svc", "javascript:alert(1)"] {
            assert_eq!((challenge(&evalai(server)), submissions(&evalai(server))), (None, None));
        }
    }
}
