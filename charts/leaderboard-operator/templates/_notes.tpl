{{/* A name that is allowed: the first pattern with a word in place of *, long enough for a bucket. Empty where nothing is. {patterns} */}}
{{- define "operator.example" -}}
{{- with first (.patterns | default list) -}}
{{- replace "*" "example" . -}}
{{- end -}}
{{- end -}}

{{/* The namespace of the manifests to paste. */}}
{{- define "operator.example.namespace" -}}
{{- include "operator.namespaces" . | splitList " " | first | default "leaderboard" -}}
{{- end -}}

{{/* What is allowed there, as JSON. */}}
{{- define "operator.example.allowed" -}}
{{- $namespace := include "operator.example.namespace" . -}}
{{- $found := dict -}}
{{- range fromJsonArray (include "operator.entries" .) }}{{ if eq .name $namespace }}{{ $found = . }}{{ end }}{{ end -}}
{{- include "operator.both" (dict "root" . "entry" $found) -}}
{{- end -}}

{{/* The URL of an allowed queue: a pattern with a slash is about the whole of it. {root, patterns, account, region} */}}
{{- define "operator.example.queue" -}}
{{- with include "operator.example" . -}}
{{- if contains "/" . -}}
{{- if hasPrefix "http" . }}{{ . }}{{ end -}}
{{- else if $.root.Values.aws.endpointURL -}}
{{- printf "%s/%s/%s" (trimSuffix "/" $.root.Values.aws.endpointURL) $.account . -}}
{{- else -}}
{{- printf "https://sqs.%s.amazonaws.com/%s/%s" $.region $.account . -}}
{{- end -}}
{{- end -}}
{{- end -}}

{{/* A Leaderboard that names what these values allow. */}}
{{- define "operator.example.leaderboard" -}}
{{- $allowed := fromJson (include "operator.example.allowed" .) -}}
{{- $region := .Values.aws.region | default "us-east-1" -}}
{{- $role := .Values.controller.roleARN | default "arn:aws:iam::123456789012:role/leaderboard-controller" -}}
{{- $secret := first ($allowed.secrets | default list) -}}
{{- $entry := include "operator.example" (dict "patterns" $allowed.secretsManager) -}}
{{- $queue := include "operator.example.queue" (dict "root" . "patterns" $allowed.queues "region" $region "account" (index (splitList ":" $role) 4)) -}}
{{- $place := include "operator.example" (dict "patterns" ($allowed.buckets | default (list "results"))) | splitn "/" 2 -}}
{{- $endpoint := .Values.aws.endpointURL -}}
apiVersion: leaderboard.carla.org/v1alpha1
kind: Leaderboard
metadata:
  name: leaderboard
spec:
  evaluation:
    carla:
      version: V2
      contents: {image: registry.example/contents:1}       # made as docs/contents-image.md says
      simulator: {image: registry.example/carla:0.9.15}
  tracks:
    - {name: sensors, carla: {codename: SENSORS}{{ if or $secret $entry }}, phase: 1{{ end }}}
  {{- if or $secret $entry }}
  evalai:                                                  # left out: submissions by hand alone
    apiServer: https://eval.ai
    challenge: 1
    {{- if $secret }}
    token: {secretKeyRef: {name: {{ $secret }}, key: auth_token}}
    {{- else }}
    token: {secretsManager: {id: {{ $entry | quote }}, key: auth_token, region: {{ $region }}}}
    {{- end }}
  {{- if and $queue .Values.bridge.enabled }}
  queue:
    sqs: {url: {{ $queue | quote }}, region: {{ $region }}}
  {{- end }}
  {{- end }}
  storage:
    s3: {bucket: {{ $place._0 | quote }}{{ with $place._1 }}, prefix: "{{ trimSuffix "/" . }}/"{{ end }}, region: {{ $region }}{{ with $endpoint }}, endpoint: {{ . | quote }}{{ end }}}
  {{- with include "operator.example" (dict "patterns" $allowed.tables) }}
  table:
    dynamoDB: {name: {{ . | quote }}, region: {{ $region }}{{ with $endpoint }}, endpoint: {{ . | quote }}{{ end }}}
  {{- end }}
  {{- with include "operator.example" (dict "patterns" $allowed.logGroups) }}
  logs:
    cloudWatch: {name: {{ . | quote }}, region: {{ $region }}{{ with $endpoint }}, endpoint: {{ . | quote }}{{ end }}}
  {{- end }}
  podIdentity:                                             # may write to the bucket
    {{- if .Values.controller.roleARN }}
    serviceAccountName: submission-worker
    roleARN: {{ regexReplaceAll "role/.*" $role "role/leaderboard-submission-worker" }}
    {{- else }}
    secretName: {{ .Values.aws.secretName | default "aws" }}
    {{- end }}
{{- end -}}

{{/* The accounts that must have them, and each rule without its reason: for those who make roles themselves. */}}
{{- define "operator.example.rights" -}}
{{- $root := . -}}
{{- $where := .Values.allNamespaces | ternary "a ClusterRole" (printf "a Role in each of %s" (include "operator.namespaces" . | replace " " ", ")) -}}
{{- $grants := list -}}
{{- $grants = append $grants (dict "component" "controller" "where" $where "rules" (include "operator.controller.rules" .)) -}}
{{- range $entry := fromJsonArray (include "operator.entries" .) -}}
{{- with include "operator.secrets.rules" (dict "root" $root "entry" $entry) -}}
{{- $grants = append $grants (dict "component" "controller" "where" (printf "a Role in %s" $entry.name) "rules" .) -}}
{{- end -}}
{{- end -}}
{{- if .Values.rbac.clusterRole -}}
{{- $grants = append $grants (dict "component" "controller" "where" "a ClusterRole" "rules" (include "operator.controller.clusterRules" .)) -}}
{{- end -}}
{{- $grants = append $grants (dict "component" "controller" "where" (printf "a Role in %s" .Release.Namespace) "rules" (include "operator.controller.ownRules" .)) -}}
{{- if .Values.bridge.enabled -}}
{{- $grants = append $grants (dict "component" "bridge" "where" $where "rules" (include "operator.bridge.rules" .)) -}}
{{- end -}}
{{- range $grants }}
{{ .where }} for the service account {{ include "operator.account" (dict "root" $root "component" .component) }}:

{{ range fromYamlArray .rules }}  - {{ toJson . }}
{{ end }}
{{- end -}}
{{- end -}}
