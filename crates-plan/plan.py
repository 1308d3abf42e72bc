#!/usr/bin/env python3
"""Target of each file, and what stands against it. plan.py ROOT table|check|cures|vis"""
import sys, os, re; sys.path.insert(0,'.')
import graph
from collections import defaultdict, Counter

# (prefix or exact file, crate, replacement). The first that fits counts.
D='src/controller/'; S='src/controller/submissions/'; L='src/controller/leaderboards/'; V='src/services/'; O='src/observability/'
RULES=[
 # base
 ('src/lock.rs','base','lock.rs'),('src/backoff.rs','base','backoff.rs'),
 (O+'tasks.rs','base','tasks.rs'),(O+'shutdown.rs','base','shutdown.rs'),(O+'about.rs','base','spans.rs'),(O+'trace_id.rs','base','trace_id.rs'),
 (V+'meter.rs','base','meter.rs'),(V+'held_text.rs','base','held_text.rs'),
 # protocol
 ('crates/runner/src/protocol.rs','protocol','files.rs'),('crates/runner/src/verdict.rs','protocol','verdict.rs'),
 ('crates/runner/','runner',None),('crates/results/','results',None),('crates/api/','api',None),('crates/kubectl-leaderboard/','kubectl-leaderboard',None),
 (V+'evalai/status.rs','api','evalai_status.rs'),
 # contract
 ('src/pod/run.rs','contract','run.rs'),('src/pod/report.rs','contract','report.rs'),('src/pod/keys.rs','contract','keys.rs'),('src/pod/schema.rs','contract','schema.rs'),
 ('src/pod/tree.rs','evidence','lib.rs'),
 # evaluation
 ('src/pod/gather.rs','evaluation','carla/gather.rs'),('src/pod/judge.rs','evaluation','carla/judge.rs'),
 ('src/pod/judge_tests.rs','evaluation','carla/judge/tests.rs'),('src/pod/judge_file_tests.rs','evaluation','carla/judge/file_tests.rs'),
 (S+'job_spec/commands.rs','evaluation','carla/commands.rs'),
 ('src/pod/tests/fixtures.rs','evaluation','fixtures.rs'),('src/pod/mod.rs','pod','lib.rs'),('src/pod/','pod',''),
 # pod-spec
 (S+'job_spec/mod.rs','pod-spec','job/mod.rs'),(S+'job_spec/','pod-spec','job/'),(S+'pod_overlay.rs','pod-spec','overlay.rs'),(S+'pod_overlay/','pod-spec','overlay/'),(S+'pod_layout.rs','pod-spec','layout.rs'),
 (D+'network_policy.rs','pod-spec','network_policy.rs'),(D+'gpu_claims.rs','pod-spec','gpu_claims.rs'),(L+'pod_notes.rs','pod-spec','notes.rs'),
 # policy
 ('src/allowed.rs','policy','allowed.rs'),('src/allowed_tests.rs','policy','allowed/tests.rs'),(L+'refusal.rs','policy','leaderboards/refusal.rs'),
 (L+'decide.rs','policy','leaderboards/decide.rs'),(L+'decide_tests.rs','policy','leaderboards/decide/tests.rs'),
 (S+'decide/','policy','submissions/'),(S+'view.rs','policy','view.rs'),(S+'report_digest.rs','policy','report_digest.rs'),(S+'phases.rs','policy','phases.rs'),
 (D+'slots/turns.rs','policy','slots/turns.rs'),(D+'slots/member.rs','policy','slots/member.rs'),(D+'slots/line.rs','policy','slots/line.rs'),(D+'slots/tests/mod.rs','root','src/slots/tests.rs'),(D+'slots/tests/','policy','slots/tests/'),(D+'census.rs','policy','census.rs'),(D+'submissions/team_use.rs','root','src/submissions/team_use.rs'),
 ('src/bridge/route.rs','policy','intake/route.rs'),('src/bridge/route_tests.rs','policy','intake/route/tests.rs'),('src/bridge/message.rs','policy','intake/message.rs'),
 # evalai
 (V+'evalai/mod.rs','evalai','lib.rs'),(V+'evalai/','evalai',''),(V+'public.rs','evalai','reach.rs'),(V+'token.rs','evalai','token.rs'),
 # aws
 (V+'mod.rs','aws','lib.rs'),(V+'aws.rs','aws','clients.rs'),(V+'aws_tests.rs','aws','clients/tests.rs'),(V,'aws',''),
 # root
 ('src/bridge/ages.rs','root','src/intake/ages.rs'),('src/bridge/source.rs','root','src/intake/source.rs'),('src/bridge/poller.rs','root','src/intake/poller.rs'),('src/bridge/pollers.rs','root','src/intake/pollers.rs'),('src/bridge/ingest','root','src/intake/ingest'),('src/bridge/','root',None),
 (D+'runtime/sweep.rs','root','src/intake/sweep.rs'),(D+'runtime/inbox','root','src/intake/inbox'),
 (D+'runtime/','root','src/runtime/'),(L,'root','src/leaderboards/'),(S,'root','src/submissions/'),(D+'slots/','root','src/slots/'),
 (D+'tests/','root','src/tests/'),(D+'mod.rs','root','(goes: its lines into src/lib.rs)'),(D,'root','src/runtime/'),
 (O+'metrics/','root','src/metrics/'),(O,'root',None),
 ('src/','root',None),
]
ORDER=['base','protocol','api','contract','evidence','results','evaluation','policy','pod-spec','evalai','aws','pod','runner','root','kubectl-leaderboard']
ALLOWED={
 'base':set(),'protocol':set(),'api':set(),'contract':{'api','protocol'},'evidence':set(),'results':set(),
 'evaluation':{'contract','evidence','results','api','protocol'},
 'policy':{'api','contract','evaluation','protocol'},
 'pod-spec':{'api','contract','evaluation','protocol'},
 'evalai':{'base','api'},'aws':{'base','contract','api'},
 'pod':{'base','protocol','contract','evidence','evaluation','aws','api','results'},
 'runner':{'protocol'},
 'kubectl-leaderboard':{'api','contract','evaluation'},
}
ALLOWED['root']=set(ORDER)-{'root','kubectl-leaderboard'}
PLACED={}
def retarget(g):
    '''Files placed by #[path] go where Rust looks for them.'''
    PLACED.clear()
    for k,m in g.mods.items():
        d=getattr(m,'decl',None)
        if not d or not d[3] or not m.file.startswith(('src/','crates/')) : continue
        if m.file in PLACED or 'fixtures' in m.file or m.file.startswith('crates/results/'): continue
        pf=d[0]
        if not pf.startswith(('src/','crates/')): continue
        c,pn=PLACED.get(pf) or target(pf)
        dir_=os.path.dirname(pn); stem=os.path.basename(pn)[:-3]
        if stem not in('mod','lib','main'): dir_=os.path.join(dir_,stem)
        # inline modules between
        q=m.parent
        inl=[]
        while q is not None and g.files.get(q.file) is not q: inl.insert(0,q.path[-1]); q=q.parent
        name=m.path[-1]
        if not name.endswith('tests'): name+='_tests'
        PLACED[m.file]=(c,os.path.join(dir_,*inl,name+'.rs'))
def target(f):
    if f in PLACED: return PLACED[f]
    return target0(f)
def target0(f):
    for p,c,r in RULES:
        if f==p or (f.startswith(p) and (p.endswith('/') or not p.endswith('.rs'))):
            if r is None: return c,f
            if c in('root',): return c,(r+f[len(p):] if not p.endswith('.rs') else r)
            base='crates/%s/src/'%c
            return c,base+(r+f[len(p):] if not p.endswith('.rs') else r)
    return None,None

# test files placed by #[path]: beside their module
def load(root):
    g=graph.load(root); retarget(g); return g
def crate_of_items(g, moves):
    """moves: {(file, name): crate}"""
    out={}
    for it in g.items:
        c=target(it.file)[0] if it.file.startswith(('src/','crates/')) else 'tests:'+it.file.split('/')[0]
        keys=[it.name]
        if it.kind=='impl': keys=[it.impl_of[1].split('::')[-1], it.name]
        for k in keys:
            if (it.file,k) in moves: c=moves[(it.file,k)]
        out[it]=c
    return out
def violations(g, moves, tests=None):
    ci=crate_of_items(g,moves); bad=defaultdict(list)
    named=defaultdict(set)
    for e in g.edges:
        f,line,test,tf,name,kind,src,dst,info=e
        if src is None or isinstance(dst,graph.Module): continue
        a=ci[src]; b=ci.get(dst)
        if b is None or a==b or a.startswith('tests:') : continue
        if tests is not None and test!=tests: continue
        if src.name=='impl' : pass
        if b not in ALLOWED.get(a,()): bad[(a,b)].append((f,line,tf,name,src.name,test))
    return bad
