// Work-items that the calling thread and waiting worker threads of a CPU share (TEAM, a build option; host/team.py).
//
// Waking a worker thread takes longer than a short launch. In a launch by a team, workers have been started before it and
// wait in the kernel: they are its members. The calling thread runs the kernel as the leader. Each thread takes the
// work-items of its share, at the end also work-items of other shares. The leader waits until all are done. Members wait
// for the next launch. They end when none comes in `poll_limit` polls, or when the host dismisses them. A leader without
// members does all work.
//
// Kernels that a team can run have TEAM_ARGUMENTS as their last arguments, and their work in FOR_EACH_ITEM(item) { ... },
// which without TEAM runs once, for this work-item. `item.x` and `item.y` are its places in two dimensions.
// ITEM_COLUMNS is the global size in the first dimension.
#ifndef TEAM_H
#define TEAM_H

#ifdef TEAM
// Share of a thread: the work-items begin <= number < end, in sequence. So it reads neighbouring memory, the same in each
// launch until the members end.
typedef struct {
    uint next;  // work-item that is begun next; not below `end` between launches
    uint begin, end;
    uint apart[13];
} Share;

// Counters that change with each work-item are in cache lines (64 bytes) of their own. host/team.py has the same offsets.
typedef struct {
    uint columns;  // work-items in the first dimension
    uint shares;   // number of shares: of the calling thread and of the members
    uint items;    // work-items of the launch
    uint core;     // core of the calling thread (NO_CORE: not known) when the members were started
    uint members;  // number of the members that were started
    uint unused[11];
    uint done;  // work-items that are complete
    uint apart[15];
    uint ended;      // members that have ended since the host started them
    uint dismissed;  // not 0: members end as soon as no work is left
    uint begun;      // members that have begun
    uint joined;     // members that have begun and stay
    uint rest[12];
    Share share[];
} Team;

#define TEAM_ARGUMENTS , global Team *team, const uint poll_limit
#define ITEM_COLUMNS team->columns
// `item`: its places in two dimensions, and the number of the thread's share.
#define FOR_EACH_ITEM(item) \
    for (uint4 item = first_item(team, poll_limit); item.z != NO_ITEM; item = next_item(team, poll_limit, item.z))
#define NO_ITEM 0xffffffffu
#define NO_CORE 0xffffffffu
#define LEADER 0  // `poll_limit` of the calling thread

// Tell the processor that this thread waits in a loop: a thread on the same core gets more of it.
#if __has_builtin(__builtin_ia32_pause)
#define PAUSE() __builtin_ia32_pause()
#else
#define PAUSE()
#endif

static inline uint load_counter(global uint *counter) { return __atomic_load_n(counter, __ATOMIC_ACQUIRE); }

// Take the next work-item of a share; return NO_ITEM without one.
static inline uint take_of(global Share *share) {
    if (load_counter(&share->next) >= share->end) return NO_ITEM;
    const uint number = __atomic_fetch_add(&share->next, 1, __ATOMIC_ACQ_REL);
    return number < share->end ? number : NO_ITEM;
}

static inline uint4 item_at(global const Team *team, uint number, uint own) {
    return (uint4)(number % team->columns, number / team->columns, own, 0);
}

// Take a work-item of the thread's own share, or of another one; without one the result has z = NO_ITEM.
static inline uint4 take_item(global Team *team, uint own) {
    for (uint i = 0; i < team->shares; i++) {
        const uint number = take_of(&team->share[(own + i) % team->shares]);
        if (number != NO_ITEM) return item_at(team, number, own);
    }
    return (uint4)NO_ITEM;
}

// Core of this thread.
static inline uint core_number(void) {
#if __has_builtin(__builtin_ia32_rdtscp)
    uint number;
    __builtin_ia32_rdtscp(&number);
    return number & 0xfff;
#else
    return NO_CORE;
#endif
}

// Begin as a member; return the number of the share. A member on the core of the calling thread would be in its way: return
// NO_ITEM for it, after all others have begun, because a worker that ends takes the next work-item, and so the place of
// another worker.
static inline uint join(global Team *team, uint poll_limit) {
    __atomic_fetch_add(&team->begun, 1, __ATOMIC_ACQ_REL);
    if (team->core == NO_CORE || core_number() != team->core) {
        return (1 + __atomic_fetch_add(&team->joined, 1, __ATOMIC_ACQ_REL)) % team->shares;
    }
    for (uint poll = 0; poll < poll_limit && load_counter(&team->begun) < team->members; poll++) PAUSE();
    return NO_ITEM;
}

// Wait as a member for a work-item of its share, of this launch or of the next one. A waiting member reads no other share:
// it would slow down the thread that changes it.
static inline uint4 wait_for_item(global Team *team, uint own, uint poll_limit) {
    if (own != NO_ITEM) {
        for (uint poll = 0; poll < poll_limit && !load_counter(&team->dismissed); poll++) {
            const uint number = take_of(&team->share[own]);
            if (number != NO_ITEM) return item_at(team, number, own);
            PAUSE();
        }
    }
    __atomic_fetch_add(&team->ended, 1, __ATOMIC_ACQ_REL);
    return (uint4)NO_ITEM;
}

// Take a work-item as the leader; without one, wait until all are done.
static inline uint4 lead_item(global Team *team) {
    const uint4 item = take_item(team, 0);
    while (item.z == NO_ITEM && load_counter(&team->done) < team->items) PAUSE();
    return item;
}

static inline uint4 first_item(global Team *team, uint poll_limit) {
    if (poll_limit != LEADER) return wait_for_item(team, join(team, poll_limit), poll_limit);
    __atomic_store_n(&team->done, 0, __ATOMIC_RELAXED);
    for (uint i = team->shares; i-- > 0;) {  // from here on members take work-items
        __atomic_store_n(&team->share[i].next, team->share[i].begin, __ATOMIC_RELEASE);
    }
    return lead_item(team);
}

static inline uint4 next_item(global Team *team, uint poll_limit, uint own) {
    __atomic_fetch_add(&team->done, 1, __ATOMIC_ACQ_REL);
    if (poll_limit == LEADER) return lead_item(team);
    const uint4 item = take_item(team, own);
    return item.z == NO_ITEM ? wait_for_item(team, own, poll_limit) : item;
}
#else
#define TEAM_ARGUMENTS
#define ITEM_COLUMNS get_global_size(0)
#define FOR_EACH_ITEM(item) const uint2 item = (uint2)(get_global_id(0), get_global_id(1));
#endif

#endif
