/* Holds rs_localizer/native/abi3.h against Python.h: the same numbers, sizes and places. Python's
   names are taken out of the way of ours, file by file. */
#include <Python.h>
#include <stddef.h>
#include <structmember.h>

enum {
    alloc = Py_tp_alloc, dealloc = Py_tp_dealloc, methods = Py_tp_methods, make = Py_tp_new,
    repr = Py_tp_repr, release = Py_tp_free, exec = Py_mod_exec, noargs = METH_NOARGS, o = METH_O,
    fastcall = METH_FASTCALL, writable = PyBUF_WRITABLE, format = PyBUF_FORMAT,
    contiguous = PyBUF_C_CONTIGUOUS,
};
typedef struct { PyObject_HEAD void *end; } OfHead;
static const size_t theirs[] = {
    sizeof(PyObject), sizeof(PyMethodDef), sizeof(PyType_Slot), sizeof(PyType_Spec),
    sizeof(PyModuleDef), sizeof(PyModuleDef_Slot), sizeof(Py_buffer), offsetof(Py_buffer, len),
    offsetof(Py_buffer, ndim), offsetof(Py_buffer, format), offsetof(Py_buffer, shape),
    offsetof(PyModuleDef, m_name), offsetof(PyModuleDef, m_slots), offsetof(PyType_Spec, flags),
    offsetof(PyType_Spec, slots), offsetof(PyMethodDef, ml_flags), offsetof(OfHead, end),
};
int their_count(void) { return sizeof theirs / sizeof *theirs; }
size_t their(int i) { return theirs[i]; }
int their_number(int i) {
    static const int numbers[] = {alloc, dealloc, methods, make, repr, release, exec, noargs, o, fastcall,
                                  writable, format, contiguous};
    return numbers[i];
}
