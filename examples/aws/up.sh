#!/usr/bin/env bash
# Makes what the operator needs of AWS besides cluster and network: policies, queues, buckets, tables, log groups, registry, the token's
# entry, and EvalAI's user. Safe to repeat: what is there as it should be stays, and what differs is brought to this folder's files.
set -euo pipefail
shopt -s inherit_errexit

usage() {
    cat <<'END'
usage: ./up.sh [--dry-run] [PART ...]

PART is one of policies, queue, leaderboards, registry, token and evalai; without one all of them are made, in this order.
--dry-run shows what would be done, and changes nothing.

Environment:
  AWS_REGION      region of queue, buckets, tables and registry
  QUEUE_NAME      the queue's name in EvalAI; a queue of that name that is there already is left as it is
  BUCKET_PREFIX   put before the buckets' names, with a hyphen
  LEADERBOARDS    names of the Leaderboards, between blanks; default: leaderboard-20
  KMS_KEY_ARN     key of the buckets; default: S3's own
  TOKEN_FILE      file with {"auth_token": "..."}; needed where the entry `evalai` is missing or is to change
END
}

# The word for what was done to one thing, and the thing.
say() { printf '%-10s %s\n' "$1" "$2"; }

# Runs a command that changes something, unless this is a dry run.
change() {
    changes=$((changes + 1))
    say "$1" "$2"
    shift 2
    if [[ $dry_run = no ]]; then "$@" >/dev/null; fi
}

stop() {
    echo "up.sh: $1" >&2
    exit 1
}

# True if AWS has the thing; every other failure ends the program with AWS's words.
is_there() {
    local words
    if words=$("$@" 2>&1 >/dev/null); then return 0; fi
    case $words in
        *NoSuchEntity* | *ResourceNotFound* | *NonExistentQueue* | *QueueDoesNotExist* | *"does not exist"*) return 1 ;;
        *) stop "$words" ;;
    esac
}

is_same_json() { [[ $(jq -S . <<<"$1") = "$(jq -S . "$2")" ]]; }

make_policy() {
    local name=leaderboard-$1 file=iam/$1.json arn version present
    arn=arn:aws:iam::$account:policy/$name
    if ! is_there aws iam get-policy --policy-arn "$arn"; then
        change make "policy $name" aws iam create-policy --policy-name "$name" --policy-document "file://$file"
        return
    fi
    version=$(aws iam get-policy --policy-arn "$arn" --query Policy.DefaultVersionId --output text)
    present=$(aws iam get-policy-version --policy-arn "$arn" --version-id "$version" --query PolicyVersion.Document --output json)
    if is_same_json "$present" "$file"; then
        say keep "policy $name"
    else
        change update "policy $name" store_version "$arn" "$file"
    fi
}

# IAM keeps five versions of a policy.
store_version() {
    local others
    others=$(aws iam list-policy-versions --policy-arn "$1" --query 'Versions[?!IsDefaultVersion].VersionId' --output text)
    read -ra others <<<"$others"
    if ((${#others[@]} >= 4)); then
        aws iam delete-policy-version --policy-arn "$1" --version-id "${others[-1]}"
    fi
    aws iam create-policy-version --policy-arn "$1" --policy-document "file://$2" --set-as-default
}

# The stack NAME of the template KIND with these parameters.
make_stack() {
    local name=$1 kind=$2 file=cloudformation/$2.yaml parameters word=make
    shift 2
    if is_there aws cloudformation describe-stacks --stack-name "$name"; then
        parameters=$(aws cloudformation describe-stacks --stack-name "$name" --query 'Stacks[0].Parameters' --output json)
        if is_same_template "$name" "$file" && has_parameters "$parameters" "$@"; then
            say keep "stack $name ($kind)"
            return
        fi
        word=update
    fi
    change "$word" "stack $name ($kind)" aws cloudformation deploy --no-fail-on-empty-changeset --stack-name "$name" \
        --template-file "$file" --parameter-overrides "$@"
}

is_same_template() {
    [[ $(aws cloudformation get-template --stack-name "$1" --query TemplateBody --output text) = "$(<"$2")" ]]
}

has_parameters() {
    local present=$1 given
    shift
    for given in "$@"; do
        jq -e --arg key "${given%%=*}" --arg value "${given#*=}" \
            'any(.[]?; .ParameterKey == $key and .ParameterValue == $value)' <<<"$present" >/dev/null || return 1
    done
}

make_policies() {
    local name
    for name in controller bridge submission-worker; do make_policy "$name"; done
    if [[ -n ${KMS_KEY_ARN:-} ]]; then make_policy kms; fi
}

make_queue() {
    local dead=leaderboard-submissions-dead
    : "${QUEUE_NAME:?is the name of the queue: EvalAI shows it on the page Manage of the challenge}"
    if is_there aws cloudformation describe-stacks --stack-name leaderboard-queue ||
        ! is_there aws sqs get-queue-url --queue-name "$QUEUE_NAME"; then
        make_stack leaderboard-queue queue "Name=$QUEUE_NAME"
        return
    fi
    say keep "queue $QUEUE_NAME, which no stack of this folder has made"
    if is_there aws sqs get-queue-url --queue-name "$dead"; then
        say keep "queue $dead"
    else
        change make "queue $dead" aws sqs create-queue --queue-name "$dead" \
            --attributes MessageRetentionPeriod=1209600,VisibilityTimeout=60,SqsManagedSseEnabled=true
    fi
}

make_leaderboards() {
    local name key=()
    : "${BUCKET_PREFIX:?is what the names of the buckets begin with}"
    if [[ -n ${KMS_KEY_ARN:-} ]]; then key=("KmsKeyArn=$KMS_KEY_ARN"); fi
    for name in ${LEADERBOARDS:-leaderboard-20}; do
        make_stack "$name" leaderboard "Name=$name" "BucketPrefix=$BUCKET_PREFIX" "${key[@]}"
    done
}

make_registry() { make_stack leaderboard-registry registry Prefix=leaderboard; }

# The token is in no argument and in no output.
make_token() {
    local present
    if ! is_there aws secretsmanager describe-secret --secret-id evalai; then
        if [[ -z ${TOKEN_FILE:-} ]]; then
            say skip "entry evalai: TOKEN_FILE names no file; make it later by: TOKEN_FILE=token.json ./up.sh token"
            return
        fi
        check_token
        change make "entry evalai" aws secretsmanager create-secret --name evalai --secret-string "file://$TOKEN_FILE"
        return
    fi
    if [[ -n ${TOKEN_FILE:-} ]]; then
        check_token
        present=$(aws secretsmanager get-secret-value --secret-id evalai --query SecretString --output text)
        if ! is_same_json "$present" "$TOKEN_FILE"; then
            change update "entry evalai" aws secretsmanager put-secret-value --secret-id evalai --secret-string "file://$TOKEN_FILE"
            return
        fi
    fi
    say keep "entry evalai"
}

check_token() {
    [[ -r $TOKEN_FILE ]] || stop "TOKEN_FILE names $TOKEN_FILE, which cannot be read"
    jq -e '.auth_token | strings | length > 0' "$TOKEN_FILE" >/dev/null ||
        stop "$TOKEN_FILE is not of the form {\"auth_token\": \"...\"}"
}

make_evalai() {
    local present
    if ! is_there aws iam get-user --user-name evalai; then
        change make "user evalai" aws iam create-user --user-name evalai
    else
        say keep "user evalai"
    fi
    if ! is_there aws iam get-user-policy --user-name evalai --policy-name evalai; then
        change make "rights of the user evalai" put_rights
        return
    fi
    present=$(aws iam get-user-policy --user-name evalai --policy-name evalai --query PolicyDocument --output json)
    if is_same_json "$present" iam/evalai.json; then
        say keep "rights of the user evalai"
    else
        change update "rights of the user evalai" put_rights
    fi
}

put_rights() { aws iam put-user-policy --user-name evalai --policy-name evalai --policy-document file://iam/evalai.json; }

dry_run=no
changes=0
parts=()
for word in "$@"; do
    case $word in
        --dry-run) dry_run=yes ;;
        policies | queue | leaderboards | registry | token | evalai) parts+=("$word") ;;
        --help | -h) usage && exit 0 ;;
        *) usage >&2 && exit 2 ;;
    esac
done
if ((${#parts[@]} == 0)); then parts=(policies queue leaderboards registry token evalai); fi

if [[ ${TOKEN_FILE:-/} != /* ]]; then TOKEN_FILE=$PWD/$TOKEN_FILE; fi
cd "${BASH_SOURCE[0]%/*}"
if grep -q '<\(ACCOUNT_ID\|REGION\|PARTICIPANTS_REGION\|PREFIX\|CHALLENGE\)>' iam/controller.json iam/bridge.json iam/submission-worker.json iam/evalai.json; then
    stop "iam/*.json still have placeholders: put your names in first, as docs/aws.md shows"
fi
export AWS_PAGER=
account=$(aws sts get-caller-identity --query Account --output text)
for part in "${parts[@]}"; do "make_$part"; done
if [[ $dry_run = yes ]]; then
    echo "$changes to change; nothing was changed."
else
    echo "$changes changed."
fi
