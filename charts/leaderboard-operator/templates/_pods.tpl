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

{{/* Where Pods may run: the affinity as given, on nodes for which the image is built. A selector of yours for the architecture goes before. {root, own, affinity} */}}
{{- define "operator.affinity" -}}
{{- $affinity := .affinity -}}
{{- $architectures := .root.Values.image.architectures -}}
{{- if and $architectures (not (hasKey .own.nodeSelector "kubernetes.io/arch")) -}}
{{- $built := dict "key" "kubernetes.io/arch" "operator" "In" "values" $architectures -}}
{{- $node := $affinity.nodeAffinity | default dict -}}
{{- $required := $node.requiredDuringSchedulingIgnoredDuringExecution | default dict -}}
{{- $terms := list -}}
{{- range $required.nodeSelectorTerms | default (list dict) -}}
{{- $terms = append $terms (merge (dict "matchExpressions" (append (.matchExpressions | default list) $built)) .) -}}
{{- end -}}
{{- $node = merge (dict "requiredDuringSchedulingIgnoredDuringExecution" (dict "nodeSelectorTerms" $terms)) (omit $node "requiredDuringSchedulingIgnoredDuringExecution") -}}
{{- $affinity = merge (dict "nodeAffinity" $node) (omit $affinity "nodeAffinity") -}}
{{- end -}}
{{- with $affinity -}}
{{- toYaml . }}
{{- end -}}
{{- end -}}

{{/* Replicas prefer different nodes, so that the loss of one does not take both. {root, component} */}}
{{- define "operator.apart" -}}
podAntiAffinity:
  preferredDuringSchedulingIgnoredDuringExecution:
    - weight: 100
      podAffinityTerm:
        topologyKey: kubernetes.io/hostname
        labelSelector:
          matchLabels:
            {{- include "operator.selector" . | nindent 12 }}
{{- end -}}

{{/* The constraints as given; one without a labelSelector is about the replicas of this program. {root, component, own} */}}
{{- define "operator.spread" -}}
{{- $replicas := dict "matchLabels" (fromYaml (include "operator.selector" .)) -}}
{{- $constraints := list -}}
{{- range .own.topologySpreadConstraints }}
{{- $constraint := . -}}
{{- if not (hasKey . "labelSelector") -}}
{{- $constraint = merge (dict "labelSelector" $replicas) . -}}
{{- end -}}
{{- $constraints = append $constraints $constraint -}}
{{- end }}
{{- toYaml $constraints -}}
{{- end -}}

{{/* What a Deployment does when its Pods change. {own, replicas} */}}
{{- define "operator.strategy" -}}
{{- with .own.strategy }}
{{- toYaml . }}
{{- else -}}
# Never Recreate: with the API server's defaults of the other type in place, no rollback could go back to it.
type: RollingUpdate
# One replica: a second one would only wait for the Lease, so the old one ends first. Several: one of them always stands by.
rollingUpdate: {{ gt (int .replicas) 1 | ternary "{maxSurge: 1, maxUnavailable: 0}" "{maxSurge: 0, maxUnavailable: 1}" }}
{{- end }}
{{- end -}}

{{/* What a Pod has besides its containers, and `helm test` too: {root, own, affinity}. */}}
{{- define "operator.pod" -}}
{{- $own := .own -}}
{{- with concat .root.Values.global.imagePullSecrets $own.imagePullSecrets | uniq }}
imagePullSecrets:
  {{- toYaml . | nindent 2 }}
{{- end }}
securityContext:
  {{- toYaml $own.podSecurityContext | nindent 2 }}
{{- with $own.runtimeClassName }}
runtimeClassName: {{ . }}
{{- end }}
{{- with $own.schedulerName }}
schedulerName: {{ . }}
{{- end }}
{{- with $own.dnsPolicy | default ($own.hostNetwork | ternary "ClusterFirstWithHostNet" "") }}
dnsPolicy: {{ . }}
{{- end }}
{{- with $own.dnsConfig }}
dnsConfig:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $own.hostAliases }}
hostAliases:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $own.nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with $own.tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with include "operator.affinity" . }}
affinity:
  {{- . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* The container of one of the two programs: {root, component, own, env}. */}}
{{- define "operator.container" -}}
{{- $own := .own -}}
name: {{ .component }}
image: {{ include "operator.image" .root | quote }}
imagePullPolicy: {{ .root.Values.image.pullPolicy }}
command: [leaderboard-operator, {{ .component }}]
{{- with $own.extraArgs }}
args:
  {{- toYaml . | nindent 2 }}
{{- end }}
env:
  {{- include "operator.env" . | nindent 2 }}
  {{- with .env }}
  {{- . | trim | nindent 2 }}
  {{- end }}
  {{- with $own.extraEnv }}
  {{- toYaml . | nindent 2 }}
  {{- end }}
ports:
  - name: http
    containerPort: 8080
  {{- if and (eq .component "controller") .root.Values.webUI.enabled }}
  # On 127.0.0.1 alone: `kubectl leaderboard dashboard` finds it by this name.
  - name: page
    containerPort: 8081
  {{- end }}
# Liveness says that the program turns; what it waits for is readiness' to name.
livenessProbe:
  httpGet: {path: /livez, port: http}
  {{- toYaml $own.livenessProbe | nindent 2 }}
readinessProbe:
  httpGet: {path: /readyz, port: http}
  {{- toYaml $own.readinessProbe | nindent 2 }}
resources:
  {{- toYaml (index .root.Values .component).resources | nindent 2 }}
securityContext:
  {{- toYaml $own.securityContext | nindent 2 }}
{{- with $own.extraVolumeMounts }}
volumeMounts:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* A Deployment of one of the two programs: {root, component, env}. */}}
{{- define "operator.deployment" -}}
{{- $root := .root -}}
{{- $own := fromJson (include "operator.own" .) -}}
{{- $replicas := (index $root.Values .component).replicas -}}
{{- $scope := merge (dict "own" $own "replicas" $replicas) . -}}
{{- $_ := set $scope "affinity" ($own.affinity | default (fromYaml (include "operator.apart" .))) -}}
apiVersion: apps/v1
kind: Deployment
metadata:
  {{- $name := printf "%s-%s" (include "operator.fullname" $root) .component }}
  {{- include "operator.metadata" (dict "root" $root "name" $name "namespace" $root.Release.Namespace "component" .component "annotations" $own.deploymentAnnotations) | nindent 2 }}
spec:
  replicas: {{ $replicas }}
  revisionHistoryLimit: {{ $own.revisionHistoryLimit }}
  strategy:
    {{- include "operator.strategy" $scope | nindent 4 }}
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
      automountServiceAccountToken: {{ $own.serviceAccount.automount }}
      # Variables for every Service of the namespace could only be mistaken for settings.
      enableServiceLinks: false
      # What is in hand is finished within 20 s.
      terminationGracePeriodSeconds: 30
      {{- with $own.priorityClassName }}
      priorityClassName: {{ . }}
      {{- end }}
      {{- if $own.hostNetwork }}
      hostNetwork: true
      {{- end }}
      {{- include "operator.pod" $scope | trim | nindent 6 }}
      {{- with $own.extraInitContainers }}
      initContainers:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      containers:
        - {{ include "operator.container" $scope | indent 10 | trim }}
        {{- with $own.extraContainers }}
        {{- toYaml . | nindent 8 }}
        {{- end }}
      {{- with $own.extraVolumes }}
      volumes:
        {{- toYaml . | nindent 8 }}
      {{- end }}
      {{- if $own.topologySpreadConstraints }}
      topologySpreadConstraints:
        {{- include "operator.spread" $scope | nindent 8 }}
      {{- end }}
{{- end -}}
