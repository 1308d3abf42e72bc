{{/* The chart's name in labels. */}}
{{- define "operator.name" -}}
{{- .Values.nameOverride | default .Chart.Name | trunc 63 | trimSuffix "-" -}}
{{- end -}}

{{/* <release>, or <release>-leaderboard-operator where the release is called something else; fullnameOverride goes before both. */}}
{{- define "operator.fullname" -}}
{{- $name := include "operator.name" . -}}
{{- if .Values.fullnameOverride -}}
{{- .Values.fullnameOverride | trunc 48 | trimSuffix "-" -}}
{{- else if contains $name .Release.Name -}}
{{- .Release.Name | trunc 48 | trimSuffix "-" -}}
{{- else -}}
{{- printf "%s-%s" .Release.Name $name | trunc 48 | trimSuffix "-" -}}
{{- end -}}
{{- end -}}

{{/* Of both programs; with a component of that one alone. */}}
{{- define "operator.selector" -}}
app.kubernetes.io/name: {{ include "operator.name" .root }}
app.kubernetes.io/instance: {{ .root.Release.Name }}
{{- with .component }}
app.kubernetes.io/component: {{ . }}
{{- end }}
{{- end -}}

{{/* The chart's own labels, then those of `labels`, then the common ones: {root, component, labels}. The first of a name counts. */}}
{{- define "operator.labels" -}}
{{- $own := fromYaml (include "operator.selector" .) -}}
{{- $own = set $own "app.kubernetes.io/version" .root.Chart.AppVersion -}}
{{- $own = set $own "app.kubernetes.io/part-of" .root.Chart.Name -}}
{{- $own = set $own "app.kubernetes.io/managed-by" .root.Release.Service -}}
{{- $own = set $own "helm.sh/chart" (printf "%s-%s" .root.Chart.Name .root.Chart.Version | replace "+" "_") -}}
{{- toYaml (merge $own (.labels | default dict) .root.Values.commonLabels) -}}
{{- end -}}

{{/* What stands below `metadata:` {root, name, namespace, component, labels, annotations}; all but root and name may be missing. */}}
{{- define "operator.metadata" -}}
name: {{ .name }}
{{- with .namespace }}
namespace: {{ . }}
{{- end }}
labels:
  {{- include "operator.labels" . | nindent 2 }}
{{- with merge (dict) (.annotations | default dict) .root.Values.commonAnnotations }}
annotations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* Ends the rendering with the next step where no image is named. The digest decides where there is one; the tag stays for people to read. */}}
{{- define "operator.image" -}}
{{- if not .Values.image.repository -}}
{{- fail "image.repository is empty, and no public image exists yet. Build and push one, `docker build --platform linux/amd64 -t REGISTRY/leaderboard-operator:TAG .` in the repository's root, then add --set image.repository=REGISTRY/leaderboard-operator,image.tag=TAG" -}}
{{- end -}}
{{- with .Values.image.registry | default .Values.global.imageRegistry -}}{{ . }}/{{- end -}}
{{- printf "%s:%s" .Values.image.repository (.Values.image.tag | default .Chart.AppVersion) -}}
{{- with .Values.image.digest -}}@{{ . }}{{- end -}}
{{- end -}}

{{/* What a program has of the values of Pods, as JSON: its own, and else those of both. Keys of a map are added. {root, component} */}}
{{- define "operator.own" -}}
{{- $own := index .root.Values .component -}}
{{- $merged := dict -}}
{{- range $key := list "serviceAccount" "deploymentAnnotations" "podAnnotations" "podLabels" "podSecurityContext" "securityContext" "imagePullSecrets" "nodeSelector" "tolerations" "affinity" "topologySpreadConstraints" "priorityClassName" "runtimeClassName" "schedulerName" "hostNetwork" "dnsPolicy" "dnsConfig" "hostAliases" "strategy" "livenessProbe" "readinessProbe" "podDisruptionBudget" "extraArgs" "extraEnv" "extraVolumes" "extraVolumeMounts" "extraContainers" "extraInitContainers" "revisionHistoryLimit" -}}
{{- $value := index $.root.Values $key -}}
{{- if and (hasKey $own $key) (kindIs "map" $value) -}}
{{- $both := dict -}}
{{- range $name, $one := $value }}{{ $_ := set $both $name $one }}{{ end -}}
{{- range $name, $one := index $own $key }}{{ $_ := set $both $name $one }}{{ end -}}
{{- $value = $both -}}
{{- else if hasKey $own $key -}}
{{- $value = index $own $key -}}
{{- end -}}
{{- $_ := set $merged $key $value -}}
{{- end -}}
{{- toJson $merged -}}
{{- end -}}

{{/* The name of a program's account. {root, component} */}}
{{- define "operator.account" -}}
{{- $default := printf "%s-%s" (include "operator.fullname" .root) .component -}}
{{- (fromJson (include "operator.own" .)).serviceAccount.name | default $default -}}
{{- end -}}

{{/* The entries of `namespaces` as JSON objects with a name; without any, the release's own namespace, unless all are served. */}}
{{- define "operator.entries" -}}
{{- $entries := list -}}
{{- $names := list -}}
{{- range .Values.namespaces -}}
{{- $entry := kindIs "string" . | ternary (dict "name" .) . -}}
{{- if has $entry.name $names -}}
{{- fail (printf "namespaces: %s is there twice: put what is allowed into one entry" $entry.name) -}}
{{- end -}}
{{- $names = append $names $entry.name -}}
{{- $entries = append $entries $entry -}}
{{- end -}}
{{- if not (or $entries .Values.allNamespaces) -}}
{{- $entries = list (dict "name" .Release.Namespace) -}}
{{- end -}}
{{- if and .Values.allow.secrets (not $entries) -}}
{{- fail "allow.secrets: Secrets are read in namespaces that have a name, also with allNamespaces: list them in `namespaces`" -}}
{{- end -}}
{{- toJson $entries -}}
{{- end -}}

{{/* The namespaces that are named, by a space. */}}
{{- define "operator.namespaces" -}}
{{- $names := list -}}
{{- range fromJsonArray (include "operator.entries" .) }}{{- $names = append $names .name -}}{{- end -}}
{{- $names | sortAlpha | join " " -}}
{{- end -}}

{{/* What is allowed everywhere and by one entry, as JSON: {root, entry}. */}}
{{- define "operator.both" -}}
{{- $both := dict -}}
{{- range $kind, $names := .root.Values.allow -}}
{{- with concat ($names | default list) (index $.entry $kind | default list) | uniq -}}
{{- $_ := set $both $kind . -}}
{{- end -}}
{{- end -}}
{{- toJson $both -}}
{{- end -}}

{{/* What Leaderboards may name, by namespace, as JSON; * is any namespace without an entry. */}}
{{- define "operator.allowed" -}}
{{- $allowed := dict -}}
{{- if .Values.allNamespaces -}}
{{- $_ := set $allowed "*" (omit (fromJson (include "operator.both" (dict "root" . "entry" dict))) "secrets") -}}
{{- end -}}
{{- range fromJsonArray (include "operator.entries" .) -}}
{{- $_ := set $allowed .name (omit (fromJson (include "operator.both" (dict "root" $ "entry" .))) "secrets") -}}
{{- end -}}
{{- toJson $allowed -}}
{{- end -}}

{{/* A role in each namespace that is served, or one for the whole cluster: {root, component, rules}. */}}
{{- define "operator.role" -}}
{{- $name := printf "%s-%s" (include "operator.fullname" .root) .component -}}
{{- if .root.Values.allNamespaces -}}
{{- include "operator.grant" (dict "root" .root "component" .component "rules" .rules "name" $name) }}
{{- else }}
{{- $scope := . }}
{{- range $index, $namespace := include "operator.namespaces" .root | splitList " " }}
{{- if $index }}
---
{{ end }}
{{- include "operator.grant" (dict "root" $scope.root "component" $scope.component "rules" $scope.rules "name" $name "in" $namespace) }}
{{- end }}
{{- end }}
{{- end -}}

{{/* A role and its binding, in a namespace or, without `in`, for the whole cluster: {root, component, name, in, rules}. */}}
{{- define "operator.grant" -}}
{{- $metadata := include "operator.metadata" (dict "root" .root "name" .name "namespace" .in) -}}
apiVersion: rbac.authorization.k8s.io/v1
kind: {{ ternary "Role" "ClusterRole" (not (empty .in)) }}
metadata:
  {{- $metadata | nindent 2 }}
rules:
{{ .rules | trimAll "\n" }}
---
apiVersion: rbac.authorization.k8s.io/v1
kind: {{ ternary "RoleBinding" "ClusterRoleBinding" (not (empty .in)) }}
metadata:
  {{- $metadata | nindent 2 }}
roleRef:
  apiGroup: rbac.authorization.k8s.io
  kind: {{ ternary "Role" "ClusterRole" (not (empty .in)) }}
  name: {{ .name }}
subjects:
  - kind: ServiceAccount
    name: {{ include "operator.account" . }}
    namespace: {{ .root.Release.Namespace }}
{{- end -}}

{{/* The programs that are installed, by a space. */}}
{{- define "operator.components" -}}
controller{{ if .Values.bridge.enabled }} bridge{{ end }}
{{- end -}}

{{/* Ends the rendering where an object's kind is unknown to the cluster: {root, value, api}. */}}
{{- define "operator.needs" -}}
{{- if not (.root.Capabilities.APIVersions.Has .api) }}
{{- fail (printf "%s.enabled: the cluster has no %s, which comes with the Prometheus Operator: install that first, or with `helm template` add --api-versions %s" .value .api .api) }}
{{- end }}
{{- end -}}
