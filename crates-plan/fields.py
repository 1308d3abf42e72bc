import re,os,sys,subprocess
from collections import defaultdict,Counter
ROOT=sys.argv[1]
INLINE=re.compile(r"^#\[cfg\(test\)\]\n(?:#\[.*\]\n)*(?:pub(?:\([a-z]+\))? )?mod \w+ \{",re.M)
def folder(p):
    if p.startswith('src/page/'): return 'page'
    if p.startswith('crates/kubectl-leaderboard/'): return 'plugin'
    if p.startswith(('tests/','benches/')) : return 'tests'
    if p.startswith('local/'): return 'local'
    if p.startswith(('charts/','crds/')): return 'chart'
    if p.startswith('examples/'): return 'examples'
    if p.startswith('docs/') or p.endswith('.md'): return 'docs'
    if p.startswith('crates/api/'): return 'api'
    if p.startswith(('src/','crates/')): return 'product'
    return None
texts=[]
for d,ds,fs in os.walk(ROOT):
    ds[:]=[x for x in ds if x not in('target','.git','corpus','node_modules','cases')]
    for f in fs:
        p=os.path.relpath(os.path.join(d,f),ROOT)
        if not f.endswith(('.rs','.yaml','.yml','.json','.md','.js','.html','.py','.sh','.toml','.tpl','.txt','.in','.tsv')): continue
        if p.startswith('crds/') or '/files/crds/' in p or p in('CHANGELOG.md','Cargo.lock') or p.startswith('docs/reference/'): continue   # generated, or history
        fo=folder(p)
        if not fo: continue
        t=open(os.path.join(d,f),errors='replace').read()
        if f.endswith('.rs') and fo in('product','api','page'):
            is_test='/tests/' in p or p.endswith(('_tests.rs','/tests.rs'))
            if is_test: texts.append((p,'tests',t)); continue
            parts=INLINE.split(t,maxsplit=1)
            texts.append((p,fo,parts[0]))
            if len(parts)>1: texts.append((p,'tests',parts[1]))
        else:
            if f.endswith('.rs') and fo=='plugin' and ('/tests/' in p or p.endswith('_tests.rs')): fo='tests'
            if '/golden/' in p or '/shown/' in p or '/printed/' in p: fo='tests'
            texts.append((p,fo,t))
def camel(c): return [r'"%s"'%c, r'(?m)^[ \-]*%s:'%c, r'`[\w.\[\]]*\b%s\b[^`]*`'%c]
F=[
('spec.leaderboardVersion','spec.evaluation.carla.version',[r'\bleaderboardVersion\b',r'\.leaderboard_version\b',r'\bleaderboard_version:']),
('spec.contents','spec.evaluation.carla.contents',[r'\bspec\.contents\b',r'spec\(\)\.contents\b',r'"contents":',r'(?m)^  +contents:',r'`contents(\.\w+)?`',r'"contents"\]']),
('spec.simulator','spec.evaluation.carla.simulator',[r'\bspec\.simulator\b',r'spec\(\)\.simulator\b',r'"simulator": ?\{',r'(?m)^  +simulator:',r'`simulator\.[\w.]+`',r'\["simulator"\]']),
('spec.pairs','spec.evaluation.carla.pairs',[r'\bspec\.pairs\b',r'spec\(\)\.pairs\b',r'\btrack\.pairs\b',r'\bt\.pairs\b',r'"pairs": ?\d',r'(?m)^ +pairs: ?\d',r'`(tracks\[\]\.)?pairs`']),
('spec.routes','spec.evaluation.carla.routes',[r'\bspec\.routes\b',r'spec\(\)\.routes\b',r'\btrack\.routes\b',r'\bt\.routes\b',r'"routes": ?\d',r'(?m)^ +routes: ?\d',r'`(tracks\[\]\.)?routes`']),
('spec.repetitions','spec.evaluation.carla.repetitions',[r'\bspec\.repetitions\b',r'\btrack\.repetitions\b',r'"repetitions": ?\d',r'(?m)^ +repetitions: ?\d',r'`(tracks\[\]\.)?repetitions`']),
('spec.verify','spec.evaluation.carla.verify',[r'\bspec\.verify\b',r'spec\(\)\.verify\b',r'"verify": ?"',r'(?m)^ +verify: ?\w',r'`verify`',r'`verify:[^`]*`']),
('spec.tracks[].codename','spec.tracks[].carla.codename (default: the name)',[r'\bcodename\b']),
('spec.tracks[].routeSubsets','spec.tracks[].carla.routeSubsets',[r'\brouteSubsets\b',r'\broute_subsets\b']),
('spec.tracks[].routesFile','spec.tracks[].carla.routesFile',[r'\broutesFile\b',r'\broutes_file\b']),
('spec.tracks[].scenariosFile','spec.tracks[].carla.scenariosFile',[r'\bscenariosFile\b',r'\bscenarios_file\b']),
('spec.tracks[].simulator','spec.tracks[].carla.simulator',[r'\btrack\.simulator\b',r'\bt\.simulator\b',r'`tracks\[\]\.simulator[^`]*`']),
('spec.simulator.{display,x11,graphicsAdapter}','the same below evaluation.carla.simulator',[r'\bgraphicsAdapter\b',r'\bgraphics_adapter\b',r'simulator\.(display|x11)\b',r'\bx11\b']),
('spec.storage','spec.storage.s3',[r'\bspec\.storage\b',r'spec\(\)\.storage\b',r'"storage": ?\{',r'"storage"\]',r'(?m)^ +storage:',r'`storage(\.\w+)?`',r'\bstorage\.(bucket|prefix|region|endpoint|size_limit|kms_key_arn|storage_class)\b']),
('spec.queue','spec.queue.sqs',[r'\bspec\.queue\b',r'spec\(\)\.queue\b',r'"queue": ?\{',r'"queue"\]',r'(?m)^ +queue:',r'`queue(\.\w+)?`',r'\bqueue\.(url|region|endpoint|dead_letter_url|foreign|unknown_after_seconds)\b']),
('spec.evalai.queue','spec.queue.evalai',[r'`evalai\.queue(\.\w+)?`',r'\bevalai\.queue\b',r'EvalaiQueue\b']),
('spec.table','spec.table.dynamoDB',[r'\bspec\.table\b',r'spec\(\)\.table\b',r'"table": ?\{',r'"table"\]',r'(?m)^ +table:',r'`table(\.\w+)?`',r'\btable\.(name|region|endpoint|partition_key|sort_key)\b']),
('spec.logGroup','spec.logs.cloudWatch',[r'\blogGroup\b',r'\blog_group\b']),
('spec.deadlines.{runSeconds,scheduleSeconds} = 0','absent; minimum 1',[r'\brunSeconds\b',r'\brun_seconds\b',r'\bscheduleSeconds\b',r'\bschedule_seconds\b']),
('"Off" (verify, network.enforcement)','Disabled',[r'"Off"',r'Verify::Off',r'Enforcement::Off',r'`(verify|network\.enforcement): Off`',r': Off\b',r'`Off`',r'\bis Off\b']),
('sizes: storage.sizeLimit, agent.logSizeLimit, agent.shmSize','int-or-string',[r'\bsizeLimit\b',r'\bsize_limit\b',r'\blogSizeLimit\b',r'\blog_size_limit\b',r'\bshmSize\b',r'\bshm_size\b']),
('status.score.{driving,routeCompletion,infractionPenalty}','status.score.{name,value} and status.metrics[]',[r'\bscore\.driving\b',r'\.driving\b',r'"driving"',r'(?m)^ +driving:',r'\brouteCompletion\b',r'\broute_completion\b',r'\binfractionPenalty\b',r'\binfraction_penalty\b']),
('status.pairs[]','status.workers[]',[r'\bstatus\.pairs\b',r'"pairs": ?\[',r'PairStatus\b',r'(?m)^ +pairs:\s*$',r'`status\.pairs[^`]*`']),
('status.failure.pair','status.failure.worker',[r'\bfailure\.pair\b',r'`failure\.pair`',r'"pair": ?\d']),
('status.progress (unit is new)','status.progress.{done,total,unit,text}',[r'\bprogress\.(done|total|text)\b',r'Progress::new',r'"progress": ?\{',r'(?m)^ +progress:']),
('status.plan.{codename,contentsImage,leaderboardVersion,repetitions,routes,simulatorImage,slices}','status.plan.carla.*',[r'\bplan\.(codename|contents_image|leaderboard_version|repetitions|routes|simulator_image|slices)\b',r'\bcontentsImage\b',r'\bsimulatorImage\b',r'"slices"']),
('status.plan.storage','status.plan.storage.s3',[r'\bplan\.storage\b']),
('status.routesBefore','status.doneBefore',[r'\broutesBefore\b',r'\broutes_before\b']),
('status.tracks[].{pairs,repetitions,routes} of a Leaderboard','status.tracks[].carla.*',[r'TrackStatus\b',r'status\.tracks\b']),
('spec.retries.perPair','spec.retries.perWorker (to be decided)',[r'\bperPair\b',r'\bper_pair\b']),
('condition Succeeded (new), Finished','conditions.rs, columns, plugin wait',[r'conditions::FINISHED\b',r'condition=Finished',r'`Finished`']),
('group and prefix literals','one constant',[r'leaderboard\.carla\.org']),
('chart: roleArn, endpointUrl (A14)','roleARN, endpointURL',[r'\broleArn\b',r'\bendpointUrl\b']),
]
cols=['api','product','plugin','page','tests','chart','examples','docs','local']
if __name__=='__main__':
    print('| today | then | '+' | '.join(cols)+' |'); print('|'+'---|'*(len(cols)+2))
    for name,then,rx in F:
        c=Counter()
        r=re.compile('|'.join('(?:%s)'%x.replace('(?m)','') for x in rx),re.M)
        for p,fo,t in texts:
            n=len(r.findall(t))
            if n: c[fo]+=n; c[fo+'#']+=1
        print('| `%s` | %s | '%(name,then)+' | '.join(('%d/%d'%(c[k],c[k+'#'])) if c[k] else '–' for k in cols)+' |')
