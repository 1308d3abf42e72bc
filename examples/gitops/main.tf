# The operator by Terraform or OpenTofu, with roles that another part of your configuration makes. Put image, region and names in.
terraform {
  required_providers {
    helm       = { source = "hashicorp/helm", version = "~> 3.0" }
    kubernetes = { source = "hashicorp/kubernetes", version = "~> 2.30" }
  }
}

variable "controller_role_arn" { type = string }
variable "bridge_role_arn" { type = string }

# The chart makes roles in this namespace, so it is there before the release.
resource "kubernetes_namespace_v1" "leaderboard" {
  metadata {
    name   = "leaderboard"
    labels = { "pod-security.kubernetes.io/enforce" = "baseline" }
  }
}

resource "helm_release" "operator" {
  name             = "leaderboard-operator"
  namespace        = "leaderboard-system"
  create_namespace = true
  # A checkout of the operator's repository, whose place is up to you.
  chart      = "${path.module}/leaderboard-operator/charts/leaderboard-operator"
  depends_on = [kubernetes_namespace_v1.leaderboard]

  values = [yamlencode({
    image      = { repository = "registry.example.com/leaderboard-operator" }
    aws        = { region = "us-east-1" }
    controller = { roleARN = var.controller_role_arn }
    bridge     = { roleARN = var.bridge_role_arn }
    namespaces = ["leaderboard"]
    # What its Leaderboards name. One that names another place is not Ready.
    allow = {
      secretsManager = ["evalai"]
      queues         = ["leaderboard-submissions*"]
      buckets        = ["leaderboard-20"]
      tables         = ["leaderboard-20"]
      logGroups      = ["leaderboard-20"]
    }
  })]
}
