# The operator's image, for those who have a container engine: `docker build -t leaderboard-operator:dev .`
# `make image` makes the same one without an engine; local/operator-image.toml is its list of files.

# The release workflow resolves both names to digests and records them (docs/versions.md); by hand they are what the tags point at.
ARG BUILD_IMAGE=rust:1.95-bookworm
ARG BASE_IMAGE=gcr.io/distroless/cc-debian12:nonroot

FROM ${BUILD_IMAGE} AS build
WORKDIR /src
# The commit, for the first line of the log and for leaderboard_build_info: --build-arg REVISION="$(git rev-parse --short HEAD)"
ARG REVISION=""
# cargo's profile of the operator and its choice of packages; `local/lab dockerfile`, which builds this file in the tests, gives those of
# the tests, so that what cargo has compiled for them is not compiled again.
ARG PROFILE=release
ARG PACKAGES="--package leaderboard-operator"
COPY . .
# Two builds, as the runner is static and small: it is copied into every Pod and runs inside any image.
RUN --mount=type=cache,target=/usr/local/cargo/registry --mount=type=cache,target=/src/target \
    triple="$(rustc -vV | sed -n 's/^host: //p')" \
    && LEADERBOARD_REVISION="$REVISION" \
       cargo build --locked --profile "$PROFILE" $PACKAGES --features otel --bin leaderboard-operator \
    && RUSTFLAGS="-C target-feature=+crt-static" \
       cargo build --locked --release --target "$triple" -p leaderboard-runner \
    && install -D -t /out "target/$PROFILE/leaderboard-operator" "target/$triple/release/leaderboard-runner"

# Has the C library, the authorities for TLS, and no shell.
FROM ${BASE_IMAGE}
COPY --from=build /out/leaderboard-operator /out/leaderboard-runner /usr/local/bin/
# One heap for all threads, given back early: next to 1,000 submissions a restart leaves 19 MB in it instead of 24.
ENV MALLOC_ARENA_MAX=1 MALLOC_TRIM_THRESHOLD_=131072
# Not the 65532 of the base: the kernel counts what a user holds over all containers of a node, and many images run as that one.
USER 60973:60973
# The base's own folder belongs to its user.
WORKDIR /
ENTRYPOINT ["leaderboard-operator"]
