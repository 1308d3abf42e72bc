#!/usr/bin/env python3
"""File and definition graph of the Rust workspace, from its own `use` lines and paths.

graph.py ROOT           parse; pickle to ROOT/../graph.pickle
As a module: Graph(root). Text only; macros' expansions and methods' receivers are not seen.
"""
import os, re, sys, pickle
from collections import defaultdict, namedtuple

TOKEN = re.compile(r'''
 (?P<ws>\s+)|(?P<lc>//[^\n]*)|(?P<bc>/\*)|
 (?P<raw>b?c?r(?P<h>\#*)".*?"(?P=h))|(?P<str>b?c?"(?:\\.|[^"\\])*")|
 (?P<chr>b?'(?:\\(?:u\{[^}]*\}|x..|.)|[^'\\])')|(?P<life>'[A-Za-z_]\w*)|
 (?P<id>(?:r\#)?[A-Za-z_]\w*)|(?P<num>\d[\w.]*?(?=\.\.|[^\w.]|\.[A-Za-z_]|$))|(?P<cc>::)|(?P<arrow>=>|->)|(?P<p>.)
''', re.X | re.S)
Tok = namedtuple('Tok', 'k v line')

def lex(text):
    out, pos, line, n = [], 0, 1, len(text)
    while pos < n:
        m = TOKEN.match(text, pos)
        k = m.lastgroup
        if k == 'h':
            k = 'raw'
        v = m.group(0)
        if k == 'bc':
            depth, i = 1, pos + 2
            while depth:
                a, b = text.find('/*', i), text.find('*/', i)
                if a != -1 and a < b: depth += 1; i = a + 2
                else: depth -= 1; i = b + 2
            v = text[pos:i]
        elif k in ('id', 'num', 'cc', 'arrow', 'p', 'life', 'str', 'raw', 'chr'):
            out.append(Tok(k, v, line))
        line += v.count('\n')
        pos += len(v)
    return out

class Module:
    def __init__(s, crate, path, file, test, parent):
        s.crate, s.path, s.file, s.test, s.parent = crate, path, file, test, parent
        s.names = {}          # name -> list of entries
        s.globs = []          # (path tuple, line, test)
        s.items = []          # Item
    def add(s, name, entry): s.names.setdefault(name, []).append(entry)

class Item:
    """One definition of a file: fn, struct, enum, impl, const, ..."""
    def __init__(s, kind, name, vis, file, line, end, test, mod):
        s.kind, s.name, s.vis, s.file, s.line, s.end, s.test, s.mod = kind, name, vis, file, line, end, test, mod
        s.toks = []
        s.uses = []          # local `use` inside
        s.impl_of = None; s.trait = None
    def __repr__(s): return f'{s.file}:{s.line} {s.kind} {s.name}'

DEFS = {'fn', 'struct', 'enum', 'union', 'type', 'const', 'static', 'trait', 'macro_rules', 'impl', 'mod', 'use', 'extern'}

class Graph:
    def __init__(s, root, crates):
        s.root, s.crates = root, {}
        s.files = {}          # file -> Module (outermost)
        s.mods = {}           # (crate, path) -> Module
        s.items = []
        s.uses = []           # (file, line, test, mod, path, alias, vis)
        s.includes = []
        for name, entry in crates.items():
            s.crates[name] = s.load(name, (), entry, False, None)
        s.edges = []
        s.resolve_all()

    # ---- parsing
    def load(s, crate, path, file, test, parent):
        m = Module(crate, path, file, test, parent)
        s.mods[(crate, path)] = m
        s.files.setdefault(file, m)
        toks = lex(open(os.path.join(s.root, file)).read())
        s.block(m, toks, 0, len(toks), file, test)
        return m

    def attrs(s, toks, i):
        found = []
        while i < len(toks) and toks[i].v == '#':
            j = i + 1
            if toks[j].v == '!': j += 1
            if toks[j].v != '[': break
            e = s.match(toks, j)
            found.append(''.join((t.v + ' ') if t.k == 'id' else t.v for t in toks[j:e]))
            i = e
        return i, found

    def match(s, toks, i):
        """Index behind the bracket that closes toks[i]."""
        depth = 0
        while i < len(toks):
            v = toks[i].v
            if toks[i].k == 'p':
                if v in '([{': depth += 1
                elif v in ')]}':
                    depth -= 1
                    if depth == 0: return i + 1
            i += 1
        return i

    def block(s, m, toks, i, end, file, test):
        while i < end:
            i, at = s.attrs(toks, i)
            if i >= end: break
            first = toks[i].line
            istest = test or any(re.match(r'\[\s*cfg\s*\(\s*(test|all\s*\(\s*test)', a) for a in at)
            pathattr = None
            for a in at:
                r = re.match(r'\[\s*path\s*=\s*"(.*)"', a)
                if r: pathattr = r.group(1)
            vis = ''
            if toks[i].v == 'pub':
                vis = 'pub'; i += 1
                if toks[i].v == '(':
                    e = s.match(toks, i); vis = 'pub' + ''.join(t.v for t in toks[i:e]); i = e
            # qualifiers
            j = i
            while toks[j].v in ('unsafe', 'async', 'default', 'const', 'extern') and toks[j].k == 'id':
                if toks[j].v == 'const' and toks[j+1].v not in ('fn', 'unsafe', 'async', 'extern'): break
                if toks[j].v == 'extern' and toks[j+1].v == 'crate': break
                j += 1
                if toks[j].k == 'str': j += 1
            kw = toks[j].v
            if kw == 'mod' and toks[j+1].k == 'id':
                name = toks[j+1].v
                if toks[j+2].v == ';':
                    s.submod(m, name, vis, istest, pathattr, file, toks[j].line)
                    i = j + 3
                else:
                    e = s.match(toks, j + 2)
                    sub = Module(m.crate, m.path + (name,), file, istest, m)
                    sub.inlinepath = pathattr
                    s.mods[(m.crate, sub.path)] = sub
                    m.add(name, ('mod', sub.path, vis, istest))
                    s.block(sub, toks, j + 3, e - 1, file, istest)
                    i = e
                continue
            if kw == 'use':
                e = j
                while toks[e].v != ';': e += 1
                for path, alias in s.usetree(toks[j+1:e]):
                    s.declare(m, path, alias, vis, istest, file)
                i = e + 1
                continue
            # an item: ends at `;` or behind its braces at depth 0
            e = j; body = False
            while e < end:
                v = toks[e].v
                if toks[e].k == 'p':
                    if v == '{':
                        e = s.match(toks, e)
                        if kw in ('const', 'static') : continue
                        break
                    if v in '([': e = s.match(toks, e); continue
                    if v == ';': e += 1; break
                e += 1
            if kw == 'macro_rules':
                name = toks[j+2].v
            elif kw == 'impl': name = None
            elif toks[j+1].k == 'id' if j + 1 < end else False: name = toks[j+1].v
            else: name = toks[j].v
            if kw in ('const','static') and name in ('mut', '_'): name = toks[j+2].v if name == 'mut' else '_'
            it = Item(kw if kw in DEFS else 'macro', name, vis, file, first, toks[min(e, end)-1].line, istest, m)
            if any('macro_export' in a for a in at): it.vis = 'pub'
            it.toks = toks[i:e]
            it.attr = at
            m.items.append(it); s.items.append(it)
            if name and kw in DEFS: m.add(name, ('def', it, vis, istest))
            for a in at:        # kube's derive makes the kind of a spec
                r = re.search(r'kind\s*=\s*"(\w+)"', a)
                if r: m.add(r.group(1), ('def', it, vis, istest))
            if e == i: e += 1
            i = e

    def submod(s, m, name, vis, test, pathattr, file, line):
        base = os.path.dirname(file)
        stem = os.path.basename(file)
        # folder of a module's children
        if m.file != file: pass
        owndir = base if stem in ('mod.rs', 'lib.rs', 'main.rs') or not m.path else os.path.join(base, stem[:-3])
        inline = []
        p = m
        while p.parent is not None and p.parent.file == file: inline.insert(0, getattr(p, 'inlinepath', None) or p.path[-1]); p = p.parent
        owndir = base if stem in ('mod.rs', 'lib.rs', 'main.rs') or not p.path else os.path.join(base, stem[:-3])
        if pathattr:
            cand = [os.path.normpath(os.path.join(base if not inline else os.path.join(owndir, *inline), pathattr))]
        else:
            d = os.path.join(owndir, *inline)
            # a file placed by #[path] is a mod-rs file
            dirs = [d, os.path.join(base, *inline)] if getattr(p, 'placed', False) else [d]
            cand = [c for dd in dirs for c in (os.path.join(dd, name + '.rs'), os.path.join(dd, name, 'mod.rs'))]
        for c in cand:
            if os.path.exists(os.path.join(s.root, c)):
                m.add(name, ('mod', m.path + (name,), vis, test))
                sub = Module(m.crate, m.path + (name,), c, test, m)
                sub.placed = bool(pathattr); sub.decl = (file, line, vis, pathattr)
                s.mods[(m.crate, sub.path)] = sub
                s.files.setdefault(c, sub)
                toks = lex(open(os.path.join(s.root, c)).read())
                s.block(sub, toks, 0, len(toks), c, test)
                return
        print('NOT FOUND', file, line, name, cand, file=sys.stderr)

    def usetree(s, toks):
        """[(path [(segment, line)], alias)]"""
        out = []
        def go(i, prefix):
            path = list(prefix)
            while i < len(toks):
                t = toks[i]
                if t.k == 'cc': i += 1; continue
                if t.v == '{':
                    e = s.match(toks, i); j = i + 1
                    while j < e - 1:
                        if toks[j].v == ',': j += 1; continue
                        j = go(j, path)
                    return e
                if t.v == '*':
                    out.append((path + [('*', t.line)], '*')); return i + 1
                if t.k == 'id':
                    if t.v == 'as':
                        p = path[:-1] if path[-1][0] == 'self' and len(path) > 1 else path
                        out.append((p, toks[i+1].v)); return i + 2
                    path.append((t.v, t.line)); i += 1
                    if i >= len(toks) or toks[i].v in ',}':
                        p = path
                        if p[-1][0] == 'self': p = p[:-1]
                        out.append((p, p[-1][0])); return i
                    continue
                return i + 1
            return i
        go(0, [])
        return out

    def declare(s, m, path, alias, vis, test, file):
        line = path[-1][1]
        segs = tuple(p[0] for p in path)
        s.uses.append((file, line, test, m, segs, alias, vis))
        if alias == '*': m.globs.append((segs[:-1], line, test, vis))
        else: m.add(alias, ('import', segs, vis, test))

    # ---- resolving
    def start(s, m, segs):
        """(module, rest) or None where the head is of another crate."""
        h = segs[0]
        if h == 'crate': return s.crates[m.crate], segs[1:]
        if h == 'self': return m, segs[1:]
        if h == 'super':
            i = 0; p = m
            while i < len(segs) and segs[i] == 'super':
                p = p.parent; i += 1
                if p is None: return None
            return p, segs[i:]
        if h in s.crates and h not in m.names: return s.crates[h], segs[1:]
        return None

    def look(s, m, segs, seen=(), localonly=False):
        """The definition that a path names: ('def', Item) or ('mod', Module), and what is left of the path; or None."""
        key = (m.crate, m.path, segs)
        if key in seen or len(seen) > 40: return None
        seen = seen + (key,)
        st = s.start(m, segs)
        if st is None:
            # a name of this module
            return s.within(m, segs, seen)
        mod, rest = st
        if not rest: return ('mod', mod, ())
        return s.within(mod, rest, seen)

    def within(s, m, segs, seen):
        name, rest = segs[0], segs[1:]
        cands = m.names.get(name, [])
        # a module first, if there is more to walk
        for e in cands:
            if e[0] == 'mod':
                sub = s.mods[(m.crate, e[1])]
                if not rest: return ('mod', sub, ())
                r = s.within(sub, rest, seen)
                if r: return r
        for e in cands:
            if e[0] == 'def': return ('def', e[1], rest)
        for e in cands:
            if e[0] == 'import':
                r = s.look(m, e[1], seen)
                if r is None: continue
                if r[0] == 'def': return ('def', r[1], r[2] + rest)
                if not rest: return r
                r2 = s.within(r[1], rest, seen)
                if r2: return r2
        for g in m.globs:
            key = ('glob', m.crate, m.path, g[0], name)
            if key in seen: continue
            r = s.look(m, g[0], seen + (key,))
            if r and r[0] == 'mod' and (r[1].crate, r[1].path) != (m.crate, m.path):
                r2 = s.within(r[1], segs, seen + (key,))
                if r2: return r2
            elif r and r[0] == 'def' and r[1].kind == 'enum':
                if re.search(r'\b' + name + r'\b', ' '.join(t.v for t in r[1].toks)): return ('def', r[1], segs)
        return None

    def resolve_all(s):
        E = s.edges     # (file, line, test, target file, target item name, kind of edge, source item, target Item or Module)
        for file, line, test, m, segs, alias, vis in s.uses:
            p = segs[:-1] if alias == '*' else segs
            r = s.look(m, p) if p else None
            if r is None: continue
            if r[0] == 'def': E.append((file, line, test, r[1].file, r[1].name, 'use', None, r[1], vis))
            else: E.append((file, line, test, r[1].file, '(' + '::'.join(r[1].path) + ')' + ('::*' if alias == '*' else ''), 'usemod', None, r[1], vis))
        for it in s.items:
            toks = it.toks; i = 0; n = len(toks)
            # local uses
            local = {}
            skip = set()
            j = 0
            while j < n:
                if toks[j].k == 'id' and toks[j].v == 'use' and (j == 0 or toks[j-1].v in ('{', '}', ';', ']')):
                    e = j
                    while toks[e].v != ';': e += 1
                    for path, alias in s.usetree(toks[j+1:e]):
                        local[alias] = tuple(p[0] for p in path)
                    skip.update(range(j, e + 1)); j = e
                j += 1
            for alias, segs in local.items():
                p = segs[:-1] if alias == '*' else segs
                r = s.look(it.mod, p)
                if r:
                    E.append((it.file, it.line, it.test, (r[1].file), r[1].name if r[0] == 'def' else '(' + '::'.join(r[1].path) + ')', 'localuse', it, r[1], ''))
            while i < n:
                t = toks[i]
                if i in skip or t.k != 'id' : i += 1; continue
                prev = toks[i-1] if i else None
                if prev is not None and (prev.v == '.' and not (i > 1 and toks[i-2].v == '.')): i += 1; continue
                if prev is not None and prev.k == 'cc': i += 1; continue
                segs = [t.v]; j = i + 1
                while j + 1 < n and toks[j].k == 'cc' and toks[j+1].k == 'id':
                    segs.append(toks[j+1].v); j += 2
                segs = tuple(segs)
                if len(segs) == 1:
                    nx = toks[j].v if j < n else ''
                    ok = t.v[0].isupper() or nx in ('(', '!') or (nx == ':' and False)
                    if not ok:
                        c = it.mod.names.get(t.v, []) or ([1] if t.v in local else [])
                        # a function handed over by name
                        ok = any(isinstance(e, tuple) and e[0] in ('import',) for e in c) and prev is not None and prev.v in '(,' and nx in '),'
                    if not ok: i = j; continue
                    if nx == ':' and t.v[0].islower(): i = j; continue
                mod = it.mod
                if segs[0] in local:
                    r = s.look(mod, local[segs[0]] + segs[1:])
                elif segs[0] in ('std', 'Self', 'self') and len(segs) == 1: r = None
                else: r = s.look(mod, segs)
                if r:
                    if r[0] == 'def' and r[1] is not it:
                        E.append((it.file, t.line, it.test, r[1].file, r[1].name, 'path' if len(segs) > 1 else 'name', it, r[1], segs))
                    elif r[0] == 'mod' and len(segs) > 1:
                        E.append((it.file, t.line, it.test, r[1].file, '(' + '::'.join(r[1].path) + ')', 'pathmod', it, r[1], segs))
                elif len(segs) > 1 and segs[0] in ('crate', 'super'):
                    print('UNRESOLVED', it.file, t.line, '::'.join(segs), file=sys.stderr)
                i = j
            if it.kind == 'impl':
                # impl<..> Trait for Type / impl Type
                k = 1
                if k < n and toks[k].v == '<':
                    d = 0
                    while k < n:
                        if toks[k].v == '<': d += 1
                        elif toks[k].v == '>' :
                            d -= 1
                            if d == 0: k += 1; break
                        k += 1
                head = []
                d = 0
                while k < n and toks[k].v not in ('{', 'where'):
                    head.append(toks[k]); k += 1
                f = [x for x, tt in enumerate(head) if tt.v == 'for' and (x + 1 >= len(head) or head[x+1].v != '<')]
                ty = head[f[0]+1:] if f else head
                tr = head[:f[0]] if f else []
                def resolve(ts):
                    ts = [x for x in ts if x.v not in ('&', 'dyn', 'mut') and x.k != 'life']
                    if not ts or ts[0].k != 'id': return None, ''.join(x.v for x in ts)
                    segs = [ts[0].v]; q = 1
                    while q + 1 < len(ts) and ts[q].k == 'cc' and ts[q+1].k == 'id': segs.append(ts[q+1].v); q += 2
                    r = s.look(it.mod, tuple(segs))
                    return (r[1] if r and r[0] == 'def' else None), '::'.join(segs)
                it.impl_of = resolve(ty); it.trait = resolve(tr) if tr else None
                it.name = 'impl ' + (it.trait[1] + ' for ' if it.trait else '') + it.impl_of[1]

CRATES = {
    'leaderboard_operator': 'src/lib.rs',
    'bin_operator': 'src/bin/leaderboard-operator.rs',
    'leaderboard_api': 'crates/api/src/lib.rs',
    'leaderboard_results': 'crates/results/src/lib.rs',
    'leaderboard_runner': 'crates/runner/src/lib.rs',
    'bin_runner': 'crates/runner/src/main.rs',
    'kubectl_leaderboard': 'crates/kubectl-leaderboard/src/main.rs',
}
def load(root, crates=None):
    sys.setrecursionlimit(20000)
    c = dict(crates or CRATES)
    if os.path.isdir(os.path.join(root, 'crates')):
        for x in sorted(os.listdir(os.path.join(root, 'crates'))):
            if os.path.exists(os.path.join(root, f'crates/{x}/src/lib.rs')): c['leaderboard_' + x.replace('-', '_')] = f'crates/{x}/src/lib.rs'
    for d in ('tests', 'crates/runner/tests', 'crates/results/tests', 'crates/kubectl-leaderboard/tests'):
        for f in sorted(os.listdir(os.path.join(root, d))) if os.path.isdir(os.path.join(root, d)) else []:
            if f.endswith('.rs'): c['it:' + d + '/' + f] = d + '/' + f
    if os.path.exists(os.path.join(root, 'benches/src/main.rs')): c['it:benches'] = 'benches/src/main.rs'
    return Graph(root, {k: v for k, v in c.items() if os.path.exists(os.path.join(root, v))})

if __name__ == '__main__':
    root = sys.argv[1]
    g = load(root)
    rs = []
    for top in ('src', 'crates'):
        for d, _, fs in os.walk(os.path.join(root, top)):
            for f in fs:
                if f.endswith('.rs'): rs.append(os.path.relpath(os.path.join(d, f), root))
    missing = sorted(set(rs) - set(g.files))
    print(len(rs), 'files;', len(g.files), 'parsed; not reached:', missing)
    print(len(g.items), 'items', len(g.edges), 'edges')
