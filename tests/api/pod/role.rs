//! The Pod's own role.

use super::*;

#[tokio::test]
async fn a_role_is_assumed_with_the_projected_token() {
    let mut pod = Pod::new().await;
    fs::write(&pod.setting.places.token, "header.payload.signature\n").unwrap();
    pod.setting.role_arn = Some("arn:aws:iam::000000000000:role/leaderboard".to_owned());
    let aws = identity::for_run(pod.aws.clone(), &pod.setting);
    let archive = Archive::new(
        aws.s3(None, Some(&server().await.endpoint())),
        &pod.setting.run.plan.storage.s3.bucket,
        "runs/77/",
    );
    archive.put("x", b"y".to_vec()).await.unwrap();
    assert_eq!(pod.stored("x").await.unwrap(), b"y");
    fs::remove_file(&pod.setting.places.token).unwrap();
    let aws = identity::for_run(pod.aws.clone(), &pod.setting);
    let archive = Archive::new(aws.s3(None, Some(&server().await.endpoint())), "b", "");
    let error = archive.put("x", Vec::new()).await.unwrap_err();
    assert!(matches!(error.cause, Cause::Denied(_)), "{error}");
}
