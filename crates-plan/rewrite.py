#!/usr/bin/env python3
"""rewrite.py ROOT CRATE...: moves the files of these target crates (plan.py) and rewrites every path that the move changes.

Changes paths and `mod` lines only. The cures of crates.md have to be in the tree before; `pub(super)` is not touched. Run `cargo fmt` after it.
With --dry: prints what it would do. Writes Cargo.toml of no crate.
"""
import os, re, subprocess, sys
sys.path.insert(0, '.')
import graph
from graph import Tok
import plan
from collections import defaultdict

# tokens with offsets
import collections
TokO = collections.namedtuple('TokO', 'k v line off')
def lex(text):
    out, pos, line, n = [], 0, 1, len(text)
    while pos < n:
        m = graph.TOKEN.match(text, pos); k = m.lastgroup; v = m.group(0)
        if k == 'h': k = 'raw'
        if k == 'bc':
            d, i = 1, pos + 2
            while d:
                a, b = text.find('/*', i), text.find('*/', i)
                if a != -1 and a < b: d += 1; i = a + 2
                else: d -= 1; i = b + 2
            v = text[pos:i]
        elif k not in ('ws', 'lc'): out.append(TokO(k, v, line, pos))
        line += v.count('\n'); pos += len(v)
    return out
graph.lex = lex

LIB = {c: 'leaderboard_' + c.replace('-', '_') for c in plan.ORDER}
LIB['root'] = 'leaderboard_operator'; LIB['kubectl-leaderboard'] = 'kubectl_leaderboard'
TOP = {v: k for k, v in LIB.items()}

def module_of(path):
    """(lib, module path) of a file by its place."""
    if path.startswith('src/bin/'): return ('bin_operator', ())
    if path.startswith('src/'): lib, rest = 'leaderboard_operator', path[4:]
    else:
        m = re.match(r'crates/([^/]+)/src/(.*)', path)
        lib, rest = LIB.get(m.group(1), m.group(1)), m.group(2)
        if m.group(1) == 'runner' : lib = 'leaderboard_runner'
    parts = rest[:-3].split('/')
    if parts[-1] in ('mod', 'lib', 'main'): parts = parts[:-1]
    return lib, tuple(parts)

def main(root, crates, dry):
    g = plan.load(root)
    moved = {}
    for f in list(g.files):
        if not f.startswith(('src/', 'crates/')): continue
        c, new = plan.target(f)
        if c in crates and new and new != f and not new.startswith('('): moved[f] = new
    # old module -> new module
    newmod = {}
    for key, m in g.mods.items():
        top = m; inner = []
        while top.parent is not None and top.parent.file == top.file and g.files[top.file] is not top: inner.insert(0, top.path[-1]); top = top.parent
        f = m.file
        if f in moved:
            lib, p = module_of(moved[f]); newmod[key] = (lib, p + tuple(inner))
        else: newmod[key] = key
    def new_of(m): return newmod[(m.crate, m.path)]
    edits = defaultdict(list)   # file -> [(start, end, text)]
    stats = defaultdict(int)

    def written(m, segs):
        """(module, rest): the longest module prefix of a path as it is written; None if it is of another world."""
        st = g.start(m, segs)
        if st is None:
            first = segs[0]
            cand = [e for e in m.names.get(first, []) if e[0] == 'mod']
            if not cand: return None
            mod, rest = g.mods[(m.crate, cand[0][1])], segs[1:]
        else: mod, rest = st
        while rest:
            e = [e for e in mod.names.get(rest[0], []) if e[0] == 'mod']
            if not e: break
            # a definition of the same name at the end of a path wins only if it is no module
            mod, rest = g.mods[(mod.crate, e[0][1])], rest[1:]
        return mod, rest

    def rewritten(m, segs):
        """The path as it has to be after the move; None: as it is."""
        w = written(m, segs)
        if w is None: return None
        mod, rest = w
        here, there = new_of(m), new_of(mod)
        # still right as it is?
        old_here, old_there = (m.crate, m.path), (mod.crate, mod.path)
        if here == old_here and there == old_there: return None
        if here[0] == there[0] and old_here[0] == old_there[0] and segs[0] in ('super', 'self') or (segs[0] not in ('super', 'self', 'crate') and segs[0] not in TOP):
            # relative: the same steps up, the same steps down
            k = 0
            while k < len(segs) and segs[k] == 'super': k += 1
            down = segs[k:len(segs) - len(rest)]
            down = down[1:] if down[:1] == ('self',) else down
            base = here[1][:len(here[1]) - k] if k else here[1]
            if here[0] == there[0] and base + tuple(down) == there[1]: return None
        head = ('crate',) if here[0] == there[0] and here[0] in TOP or here[0] == there[0] else (there[0],)
        return head + there[1] + tuple(rest)

    def use_edit(f, m, toks, i, e):
        """toks[i] is `use`, toks[e] its `;`."""
        leaves = g.usetree([Tok(t.k, t.v, t.line) for t in toks[i+1:e]])
        out, changed = [], False
        for path, alias in leaves:
            segs = tuple(p[0] for p in path)
            star = alias == '*'
            core = segs[:-1] if star else segs
            new = rewritten(m, core) if core else None
            if new is not None: changed = True
            fin = new if new is not None else core
            out.append((fin, '*' if star else (alias if alias != core[-1] or (alias != fin[-1]) else None)))
        if not changed: return
        groups = {}
        for p, a in out:
            if a == '*': groups.setdefault(p, []).append('*'); continue
            groups.setdefault(p[:-1], []).append(p[-1] + (f' as {a}' if a else ''))
        for p, names in list(groups.items()):     # `a` and `a::B` together are `a::{self, B}`
            if p and p in groups and p[:-1] in groups and p[-1] in groups[p[:-1]] and names != ['*']:
                groups[p[:-1]].remove(p[-1]); names.insert(0, 'self')
                if not groups[p[:-1]]: del groups[p[:-1]]
        start = toks[i].off
        # visibility stands before `use`
        text = open(os.path.join(root, f)).read()
        line_start = text.rfind('\n', 0, start) + 1
        vis = text[line_start:start].strip()
        vis = vis if vis.startswith('pub') else ''
        indent = re.match(r'\s*', text[line_start:]).group(0)
        lines = []
        for p, names in groups.items():
            body = names[0] if len(names) == 1 else '{' + ', '.join(names) + '}'
            lines.append('use ' + '::'.join(p + (body,)) + ';' if p else 'use ' + body + ';')
        sep = '\n' + indent + (vis + ' ' if vis else '')
        edits[f].append((start, toks[e].off + 1, sep.join(lines))); stats['use'] += 1

    # module level `use`: found again by a walk over the tokens with the module of each place
    def walk(m, toks, i, end, f):
        while i < end:
            i, at = g.attrs(toks, i)
            if i >= end: break
            if toks[i].v == 'pub':
                i += 1
                if toks[i].v == '(': i = g.match(toks, i)
            j = i
            while toks[j].v in ('unsafe', 'async', 'default', 'const', 'extern') and toks[j].k == 'id':
                if toks[j].v == 'const' and toks[j+1].v not in ('fn', 'unsafe', 'async', 'extern'): break
                if toks[j].v == 'extern' and toks[j+1].v == 'crate': break
                j += 1
                if toks[j].k == 'str': j += 1
            kw = toks[j].v
            if kw == 'mod' and toks[j+1].k == 'id':
                if toks[j+2].v == ';': i = j + 3
                else:
                    e = g.match(toks, j + 2)
                    walk(g.mods[(m.crate, m.path + (toks[j+1].v,))], toks, j + 3, e - 1, f); i = e
                continue
            if kw == 'use':
                e = j
                while toks[e].v != ';': e += 1
                use_edit(f, m, toks, j, e); i = e + 1; continue
            e = j
            while e < end:
                v = toks[e].v
                if toks[e].k == 'p':
                    if v == '{':
                        e = g.match(toks, e)
                        if kw in ('const', 'static'): continue
                        break
                    if v in '([': e = g.match(toks, e); continue
                    if v == ';': e += 1; break
                e += 1
            body(m, toks, i, e, f)
            i = e if e > i else e + 1
    def body(m, toks, i, end, f):
        while i < end:
            t = toks[i]
            if t.k != 'id': i += 1; continue
            if t.v == 'use' and toks[i-1].v in ('{', '}', ';', ']'):
                e = i
                while toks[e].v != ';': e += 1
                use_edit(f, m, toks, i, e); i = e + 1; continue
            prev = toks[i-1]
            if prev.k == 'cc' or prev.v == '$' or (prev.v == '.' and toks[i-2].v != '.'): i += 1; continue
            j = i + 1; segs = [t.v]
            while j + 1 < end and toks[j].k == 'cc' and toks[j+1].k == 'id': segs.append(toks[j+1].v); j += 2
            if len(segs) > 1 and segs[0] in ('crate', 'super', 'self') or (len(segs) > 1 and segs[0] in TOP):
                new = rewritten(m, tuple(segs))
                if new is not None:
                    last = toks[j-1]
                    edits[f].append((t.off, last.off + len(last.v), '::'.join(new))); stats['path'] += 1
            i = j
    for f, top in list(g.files.items()):
        text = open(os.path.join(root, f)).read()
        toks = lex(text)
        walk(top, toks, 0, len(toks), f)
    # `mod` lines
    decls = defaultdict(list)    # new parent file -> lines
    for key, m in g.mods.items():
        d = getattr(m, 'decl', None)
        if not d: continue
        pf, line, vis, pathattr = d
        if m.file not in moved and pf not in moved: continue
        nf, np = moved.get(m.file, m.file), moved.get(pf, pf)
        lib, p = module_of(nf); plib, pp = module_of(np)
        text = open(os.path.join(root, pf)).read(); ls = text.split('\n')
        k = line - 1; a = k
        while a > 0 and ls[a-1].strip().startswith('#['): a -= 1
        off = sum(len(x) + 1 for x in ls[:a]); end = sum(len(x) + 1 for x in ls[:k+1])
        attrs = [x for x in ls[a:k] if not x.strip().startswith('#[path')]
        if p and lib == plib and p[:-1] == pp:
            if pathattr or p[-1] != m.path[-1]:
                edits[pf].append((off, end, '\n'.join(attrs + [f'{vis + " " if vis else ""}mod {p[-1]};']) + '\n')); stats['mod'] += 1
        else:
            edits[pf].append((off, end, '')); stats['mod'] += 1
            if not p: continue
            if m.test and not any('cfg' in x for x in attrs): attrs.insert(0, '#[cfg(test)]')
            par = p[:-1]
            base = 'src' if lib == 'leaderboard_operator' else 'crates/' + TOP[lib] + '/src'
            if not par: target = base + '/lib.rs'
            else:
                cand = [base + '/' + '/'.join(par) + '.rs', base + '/' + '/'.join(par) + '/mod.rs']
                have = set(moved.values()) | {x for x in g.files if x not in moved}
                target = next((c for c in cand if c in have), cand[1])
            decls[target].append('\n'.join(attrs + [f'pub mod {p[-1]};']) if not m.test else '\n'.join(attrs + [f'mod {p[-1]};']))
    have = set(moved.values()) | {x for x in g.files if x not in moved}
    for f in list(decls):     # new folders are modules of their parents
        while f not in have and os.path.basename(f) == 'mod.rs':
            folder = os.path.dirname(f); up = os.path.dirname(folder)
            cand = [up + '/lib.rs'] if os.path.basename(up) == 'src' else [up + '.rs', up + '/mod.rs']
            parent = next((c for c in cand if c in have or c in decls), cand[-1])
            line = 'pub mod ' + os.path.basename(folder) + ';'
            if line not in decls[parent]: decls[parent].append(line)
            f = parent
    if dry:
        print(len(moved), 'files', dict(stats), 'new mod lines:', {k: len(v) for k, v in decls.items()}); return
    for f, es in edits.items():
        path = os.path.join(root, f); text = open(path).read(); last = None
        for s, e, t in sorted(es, reverse=True):
            if last is not None and e > last: print('OVERLAP', f, s, e, file=sys.stderr); continue
            text = text[:s] + t + text[e:]; last = s
        open(path, 'w').write(text)
    for old, new in moved.items():
        os.makedirs(os.path.join(root, os.path.dirname(new)), exist_ok=True)
        if subprocess.call(['git', '-C', root, 'mv', old, new], stderr=subprocess.DEVNULL): os.rename(os.path.join(root, old), os.path.join(root, new))
    for f, lines in decls.items():
        path = os.path.join(root, f); os.makedirs(os.path.dirname(path), exist_ok=True)
        text = open(path).read() if os.path.exists(path) else ''
        new = '\n'.join(sorted(set(lines)))
        if not text: text = new + '\n'
        else:
            m = re.search(r'(?m)^(?:pub(?:\([a-z ]+\))? )?mod \w+;', text)
            k = m.start() if m else 0
            if not m:      # behind the module's text and inner attributes
                ls = text.split('\n'); n = 0
                while n < len(ls) and (ls[n].startswith(('//!', '#![')) or not ls[n].strip()): n += 1
                k = sum(len(x) + 1 for x in ls[:n])
            text = text[:k] + new + '\n' + text[k:]
        open(path, 'w').write(text)
    # files that a macro names beside the file
    print(len(moved), 'files moved;', dict(stats), '; new mod lines in', sorted(decls))

if __name__ == '__main__':
    a = [x for x in sys.argv[1:] if x != '--dry']
    main(a[0], set(a[1:]), '--dry' in sys.argv)
