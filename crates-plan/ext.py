import sys,re; sys.path.insert(0,'.')
import graph
from collections import defaultdict
EXT={'axum','aws_config','aws_credential_types','aws_sdk_cloudwatchlogs','aws_sdk_dynamodb','aws_sdk_s3','aws_sdk_secretsmanager','aws_sdk_sqs','aws_sdk_sts','aws_smithy_http_client','aws_smithy_types','aws_smithy_runtime_api','base64','clap','clap_mangen','fastrand','futures','hex','http','hyper','jiff','k8s_openapi','kube','nix','opentelemetry','opentelemetry_otlp','opentelemetry_sdk','opentelemetry_proto','percent_encoding','prometheus_client','reqwest','rustls','serde','serde_saphyr','serde_json','sha2','thiserror','tokio','tracing','tracing_subscriber','proptest','tempfile','schemars','ryu','signal_hook','rustix','strsim','terminal_size','unicode_width','tower_test','prost','kube_cel','allocation_counter','challenge_probe','challenge_stand_in','evalai_stand_in','stats_alloc'}
def ext(g):
    d=defaultdict(lambda:defaultdict(set))  # file -> (test?) -> {(crate, path)}
    for file,line,test,m,segs,alias,vis in g.uses:
        if segs[0] in EXT and segs[0] not in m.names or segs[0] in EXT and len(segs)>1: d[file][test].add('::'.join(segs))
    for it in g.items:
        toks=it.toks
        for i,t in enumerate(toks):
            if t.k=='id' and t.v in EXT and i+1<len(toks) and toks[i+1].k=='cc' and (i==0 or toks[i-1].k!='cc'):
                if any(e[0]=='mod' for e in it.mod.names.get(t.v,[])): continue
                j=i; s=[t.v]
                while j+2<len(toks) and toks[j+1].k=='cc' and toks[j+2].k=='id': s.append(toks[j+2].v); j+=2
                d[file_of(it)][it.test].add('::'.join(s))
        for a in it.attr:
            for m in re.finditer(r'\b([a-z_0-9]+)\s*::',a):
                if m.group(1) in EXT: d[it.file][it.test].add(m.group(1)+'::@')
    return d
def file_of(it): return it.file
if __name__=='__main__':
    g=graph.load(sys.argv[1]); d=ext(g)
    for f in sorted(d):
        if any(f.startswith(p) for p in sys.argv[2:]) and not g.files[f].test: print(f,' '.join(sorted(x for x in d[f][False] if not x.startswith(('serde::','std')))))
