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

{{/* The digest decides where there is one; the tag stays for people to read. */}}
{{- define "operator.image" -}}
{{- printf "%s:%s" .Values.image.repository (.Values.image.tag | default .Chart.AppVersion) -}}
{{- with .Values.image.digest -}}@{{ . }}{{- end -}}
{{- end -}}

{{- define "operator.account" -}}
{{- $own := printf "%s-%s" (include "operator.fullname" .root) .component -}}
{{- (index .root.Values .component).serviceAccount.name | default $own -}}
{{- end -}}

{{/* The namespaces that are served, by a space. */}}
{{- define "operator.namespaces" -}}
{{- $names := list -}}
{{- range .Values.leaderboards }}{{- if ne .namespace "*" }}{{- $names = append $names .namespace -}}{{- end }}{{- end -}}
{{- $names | default (list .Release.Namespace) | uniq | sortAlpha | join " " -}}
{{- end -}}

{{/* What Leaderboards may name, by namespace, as JSON. */}}
{{- define "operator.allowed" -}}
{{- $allowed := dict -}}
{{- range .Values.leaderboards -}}
{{- if hasKey $allowed .namespace -}}
{{- fail (printf "leaderboards: the namespace %s is there twice: put its names into one entry" .namespace) -}}
{{- end -}}
{{- if and (eq .namespace "*") (not $.Values.allNamespaces) -}}
{{- fail "leaderboards: the namespace * needs allNamespaces: true; name the namespaces" -}}
{{- end -}}
{{- if and (eq .namespace "*") .secrets -}}
{{- fail "leaderboards: Secrets are read in a namespace that has a name, and * is none: list the namespace" -}}
{{- end -}}
{{- $allowed = set $allowed .namespace (omit . "namespace" "secrets") -}}
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

{{/* Environment that controller and bridge have in common. */}}
{{- define "operator.env" -}}
{{- $values := .root.Values -}}
- name: POD_NAME
  valueFrom: {fieldRef: {fieldPath: metadata.name}}
- name: POD_NAMESPACE
  valueFrom: {fieldRef: {fieldPath: metadata.namespace}}
- name: POD_UID
  valueFrom: {fieldRef: {fieldPath: metadata.uid}}
- name: LEADERBOARD_NAMESPACES
  value: {{ $values.allNamespaces | ternary "" (include "operator.namespaces" .root | replace " " ",") | quote }}
# What Leaderboards may name, where the operator's own AWS identity is used.
- name: LEADERBOARD_ALLOWED
  value: {{ include "operator.allowed" .root | quote }}
- name: LEADERBOARD_HTTP
  value: 0.0.0.0:8080
- name: LEADERBOARD_LOG_FORMAT
  value: {{ $values.log.format }}
- name: RUST_LOG
  value: {{ $values.log.level | quote }}
{{- with $values.aws.region }}
- name: AWS_REGION
  value: {{ . | quote }}
{{- end }}
{{- with $values.aws.endpointURL }}
- name: AWS_ENDPOINT_URL
  value: {{ . | quote }}
{{- end }}
{{- with $values.aws.secretName }}
# The keys one by one: whatever else is in that Secret does not become a setting.
- name: AWS_ACCESS_KEY_ID
  valueFrom: {secretKeyRef: {name: {{ . }}, key: AWS_ACCESS_KEY_ID}}
- name: AWS_SECRET_ACCESS_KEY
  valueFrom: {secretKeyRef: {name: {{ . }}, key: AWS_SECRET_ACCESS_KEY}}
- name: AWS_SESSION_TOKEN
  valueFrom: {secretKeyRef: {name: {{ . }}, key: AWS_SESSION_TOKEN, optional: true}}
{{- end }}
{{- end -}}

{{/* Own affinity, or: replicas prefer different nodes, so that the loss of one does not take both. {root, component} */}}
{{- define "operator.affinity" -}}
{{- with (index .root.Values .component).affinity }}
{{- toYaml . }}
{{- else -}}
podAntiAffinity:
  preferredDuringSchedulingIgnoredDuringExecution:
    - weight: 100
      podAffinityTerm:
        topologyKey: kubernetes.io/hostname
        labelSelector:
          matchLabels:
            {{- include "operator.selector" . | nindent 12 }}
{{- end }}
{{- end -}}

{{/* The constraints as given; one without a labelSelector is about the replicas of this program. {root, component} */}}
{{- define "operator.spread" -}}
{{- $replicas := dict "matchLabels" (fromYaml (include "operator.selector" .)) -}}
{{- $constraints := list -}}
{{- range (index .root.Values .component).topologySpreadConstraints }}
{{- $constraint := . -}}
{{- if not (hasKey . "labelSelector") -}}
{{- $constraint = merge (dict "labelSelector" $replicas) . -}}
{{- end -}}
{{- $constraints = append $constraints $constraint -}}
{{- end }}
{{- toYaml $constraints -}}
{{- end -}}

{{/* A Deployment of one of the two programs: {root, component, env}. */}}
{{- define "operator.deployment" -}}
{{- $root := .root -}}
{{- $own := index $root.Values .component -}}
apiVersion: apps/v1
kind: Deployment
metadata:
  {{- $name := printf "%s-%s" (include "operator.fullname" $root) .component }}
  {{- include "operator.metadata" (dict "root" $root "name" $name "namespace" $root.Release.Namespace "component" .component) | nindent 2 }}
spec:
  replicas: {{ $own.replicas }}
  revisionHistoryLimit: {{ $root.Values.revisionHistoryLimit }}
  strategy:
    # Never Recreate: with the API server's defaults of the other type in place, no rollback could go back to it.
    type: RollingUpdate
    # One replica: a second one would only wait for the Lease, so the old one ends first. Several: one of them always stands by.
    rollingUpdate: {{ gt (int $own.replicas) 1 | ternary "{maxSurge: 1, maxUnavailable: 0}" "{maxSurge: 0, maxUnavailable: 1}" }}
  selector:
    matchLabels:
      {{- include "operator.selector" . | nindent 6 }}
  template:
    metadata:
      labels:
        {{- include "operator.labels" (dict "root" $root "component" .component "labels" $own.podLabels) | nindent 8 }}
      annotations:
        kubectl.kubernetes.io/default-container: {{ .component }}
        {{- with $own.podAnnotations }}
        {{- toYaml . | nindent 8 }}
        {{- end }}
    spec:
      serviceAccountName: {{ include "operator.account" . }}
      # Variables for every Service of the namespace could only be mistaken for settings.
      enableServiceLinks: false
      # What is in hand is finished within 20 s.
      terminationGracePeriodSeconds: 30
      {{- with $own.priorityClassName }}
      priorityClassName: {{ . }}
      {{- end }}
      {{- with $root.Values.imagePullSecrets }}
      imagePullSecrets:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      securityContext:
        {{- toYaml $root.Values.podSecurityContext | nindent 8 }}
      containers:
        - name: {{ .component }}
          image: {{ include "operator.image" $root | quote }}
          imagePullPolicy: {{ $root.Values.image.pullPolicy }}
          command: [leaderboard-operator, {{ .component }}]
          env:
            {{- include "operator.env" . | nindent 12 }}
            {{- with .env }}
            {{- . | trim | nindent 12 }}
            {{- end }}
            {{- with $own.extraEnv }}
            {{- toYaml . | nindent 12 }}
            {{- end }}
          ports:
            - name: http
              containerPort: 8080
            {{- if and (eq .component "controller") $own.page.enabled }}
            # On 127.0.0.1 alone: `kubectl leaderboard dashboard` finds it by this name.
            - name: page
              containerPort: 8081
            {{- end }}
          # Liveness says that the program turns; what it waits for is readiness' to name.
          livenessProbe:
            httpGet: {path: /livez, port: http}
            periodSeconds: 10
            timeoutSeconds: 5
            failureThreshold: 6
          readinessProbe:
            httpGet: {path: /readyz, port: http}
            periodSeconds: 5
            timeoutSeconds: 5
          resources:
            {{- toYaml $own.resources | nindent 12 }}
          securityContext:
            {{- toYaml $root.Values.securityContext | nindent 12 }}
          {{- with $own.extraVolumeMounts }}
          volumeMounts:
            {{- toYaml . | nindent 12 }}
          {{- end }}
      {{- with $own.extraVolumes }}
      volumes:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      {{- with $own.nodeSelector }}
      nodeSelector:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      {{- with $own.tolerations }}
      tolerations:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      affinity:
        {{- include "operator.affinity" . | nindent 8 }}
      {{- if $own.topologySpreadConstraints }}
      topologySpreadConstraints:
        {{- include "operator.spread" . | nindent 8 }}
      {{- end }}
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
